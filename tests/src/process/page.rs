//! A client of the live page's WebSocket, for tests without a browser.

use std::io::ErrorKind;
use std::net::TcpStream;
use std::time::Instant;

use serde_json::Value;
use tungstenite::client::IntoClientRequest;
use tungstenite::{Error, Message, WebSocket, client};

use super::{Running, TIMEOUT, TestDir, skin, until};

/// A scenario without events; the arm gives way.
pub const QUIET: &str = "version = 1\nduration_s = 600.0\n\n[motion]\nkind = \"kinesthetic\"\n\
                     start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]\n";

/// A connection to the WebSocket of a live page.
pub struct Page {
    pub socket: WebSocket<TcpStream>,
    pub scene: Value,
}

/// A snapshot that the page shows: six joints, and all cells.
pub struct Snapshot {
    pub time: f64,
    /// The position, the distributed torque and the central torque of each joint.
    pub joints: Vec<[f32; 3]>,
    /// The status, the flags and the force in mN of each cell.
    pub cells: Vec<(u8, u8, u16)>,
}

/// The address of a page.
#[derive(Clone, Debug)]
pub struct Address {
    /// The host and port, such as `127.0.0.1:8100`.
    pub host: String,
    /// The query with the token, such as `?token=...`, or an empty text.
    pub query: String,
}

impl Address {
    /// Parses a URL such as `http://127.0.0.1:8100/?token=...`.
    pub fn parse(url: &str) -> Self {
        let (host, query) = url.strip_prefix("http://").unwrap().split_once('/').unwrap();
        Self { host: host.to_owned(), query: query.to_owned() }
    }

    /// Returns the address that a browser opens.
    pub fn url(&self) -> String {
        format!("http://{}/{}", self.host, self.query)
    }
}

/// Returns the address that the server of a run or a view reports.
pub fn address(served: &Running) -> Address {
    Address::parse(&announced_url(served, "view", "http"))
}

/// Returns the URL that a program reports on standard error, after a word and a colon.
pub fn announced_url(served: &Running, word: &str, scheme: &str) -> String {
    served.wait_for_stderr(&format!("{word}: {scheme}://"));
    let said = || {
        let said = served.stderr();
        let (line, _) = said.split_once(&format!("{word}: "))?.1.split_once('\n')?;
        Some(line.trim_end().to_owned())
    };
    until("the whole address", said)
}

/// Requests a WebSocket, with additional or different headers.
pub fn request_websocket(
    Address { host, query }: &Address,
    headers: &[(&'static str, &str)],
) -> Result<(WebSocket<TcpStream>, u16), Error> {
    shake_hands(TcpStream::connect(host).unwrap(), &format!("ws://{host}/live{query}"), headers)
}

/// Requests a WebSocket on a connection, with additional or different headers.
pub fn shake_hands(
    stream: TcpStream,
    url: &str,
    headers: &[(&'static str, &str)],
) -> Result<(WebSocket<TcpStream>, u16), Error> {
    stream.set_read_timeout(Some(TIMEOUT)).unwrap();
    let mut request = url.into_client_request()?;
    for (name, value) in headers {
        request.headers_mut().insert(*name, value.parse().unwrap());
    }
    match client(request, stream) {
        Ok((socket, response)) => Ok((socket, response.status().as_u16())),
        Err(tungstenite::HandshakeError::Failure(error)) => Err(error),
        Err(tungstenite::HandshakeError::Interrupted(_)) => panic!("no answer"),
    }
}

impl Page {
    pub fn new(address: &Address) -> Self {
        Self::attempt(address).unwrap()
    }

    /// Opens a page, unless it is refused.
    pub fn attempt(address: &Address) -> Result<Self, Error> {
        let (mut socket, _) = request_websocket(address, &[("Origin", &format!("http://{}", address.host))])?;
        let scene = serde_json::from_str(socket.read()?.to_text()?).unwrap();
        Ok(Self { socket, scene })
    }

    pub fn send(&mut self, command: &str) {
        self.socket.send(Message::text(command)).unwrap();
    }

    pub fn press(&mut self, node: u8, force_n: f64) {
        self.send(&format!(r#"{{"do":"press","cell":{node},"force_n":{force_n}}}"#));
    }

    /// Sends an action on the process of a cell.
    pub fn act(&mut self, action: &str, node: u8) {
        self.send(&format!(r#"{{"do":"{action}","cell":{node}}}"#));
    }

    /// Waits for the answer to a command with this text; returns true if the command was carried out.
    pub fn answer(&mut self, text: &str) -> bool {
        let is_it = |answer: &&Value| answer["text"].as_str().unwrap().contains(text);
        let answers = |said: &Value| said["bench"]["answers"].as_array().cloned().unwrap_or_default();
        let said = self.wait_for_status(text, |said| answers(said).iter().any(|answer| is_it(&answer)));
        answers(&said).iter().rfind(is_it).unwrap()["done"].as_bool().unwrap()
    }

    /// Waits for a snapshot for which a condition holds.
    pub fn wait_for_snapshot(&mut self, what: &str, mut is: impl FnMut(&Snapshot) -> bool) -> Snapshot {
        let give_up = Instant::now() + TIMEOUT;
        loop {
            assert!(Instant::now() < give_up, "not there after {TIMEOUT:?}: {what}");
            // The history before a position is not a snapshot.
            if let Message::Binary(bytes) = self.read_message()
                && bytes[12] == 0
            {
                let snapshot = Snapshot::read(&bytes);
                if is(&snapshot) {
                    return snapshot;
                }
            }
        }
    }

    /// Reads a message. A signal to the test program interrupts a read, which is then repeated.
    fn read_message(&mut self) -> Message {
        loop {
            match self.socket.read() {
                Err(Error::Io(error)) if error.kind() == ErrorKind::Interrupted => {}
                message => return message.unwrap(),
            }
        }
    }

    /// Waits for a status message for which a condition holds.
    pub fn wait_for_status(&mut self, what: &str, mut is: impl FnMut(&Value) -> bool) -> Value {
        let give_up = Instant::now() + TIMEOUT;
        loop {
            assert!(Instant::now() < give_up, "not there after {TIMEOUT:?}: {what}");
            if let Message::Text(text) = self.read_message() {
                let said = serde_json::from_str(text.as_str()).unwrap();
                if is(&said) {
                    return said;
                }
            }
        }
    }
}

impl Snapshot {
    pub fn read(bytes: &[u8]) -> Self {
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        let (joints, cells) = (word(4) as usize, word(8) as usize);
        assert_eq!(bytes.len(), 24 + 12 * joints + 8 * cells);
        let of_joint = |joint| [0, 4, 8].map(|at| f32::from_bits(word(24 + 12 * joint + at)));
        let of_cell = |cell| {
            let at = 24 + 12 * joints + 8 * cell;
            (bytes[at], bytes[at + 1], u16::from_le_bytes([bytes[at + 2], bytes[at + 3]]))
        };
        Self {
            time: f64::from_le_bytes(bytes[16..24].try_into().unwrap()),
            joints: (0..joints).map(of_joint).collect(),
            cells: (0..cells).map(of_cell).collect(),
        }
    }
}

/// Starts a run with a page, and returns both the run and the page's address.
pub fn watched(place: &TestDir, cells: usize, more: &str) -> (Running, Address) {
    // A busy machine must not halt the robot.
    place.write("skin.toml", &(skin(cells) + "\n[safety]\nbad_cycles = 10000\n"));
    watched_skin(place, more)
}

/// Starts a run of the existing `skin.toml` with a page, and returns both the run and the page's address.
pub fn watched_skin(place: &TestDir, more: &str) -> (Running, Address) {
    place.scenario(QUIET);
    let words = format!(
        "run skin.toml --bus-kind {} --scenario scenario.toml --view --summary run.json {more}",
        place.kind()
    );
    let run = place.start("skinbus", &words);
    let address = address(&run);
    (run, address)
}
