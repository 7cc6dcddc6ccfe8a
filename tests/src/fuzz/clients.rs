//! Fuzz targets for the gateway's sockets, which take input from pages in a browser and from external controllers. The
//! sockets are real.

use std::cell::RefCell;
use std::io::{Read as _, Write as _};
use std::net::{Ipv4Addr, Shutdown, TcpListener, TcpStream};
use std::os::unix::net::UnixDatagram;
use std::time::Duration;

use control::controller::{Controller as _, ControllerInput, ControllerOutput};
use control::external::ExternalController;
use protocol::skin::Skin;
use tempfile::TempDir;
use view::server::{PageAccess, Server};

/// Returns the HTTP request that upgrades a connection to the WebSocket of a page.
fn upgrade(port: u16) -> String {
    format!(
        "GET /live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nOrigin: http://127.0.0.1:{port}\r\nConnection: Upgrade\r\n\
         Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
}

/// Sends these bytes, as a request or, if the first one is odd, as a page; the server must then still answer another
/// connection.
pub(super) fn page(data: &[u8]) {
    thread_local! {
        static SERVER: Server = {
            let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
            let access = PageAccess { may_act: true, may_play: true, token: None };
            Server::start(listener, access, "{}".to_owned(), vec![1, 2, 3]).unwrap()
        };
    }
    SERVER.with(|server| {
        let port = server.address().port();
        let is_page = data.first().is_some_and(|first| first % 2 == 1);
        let begin = if is_page { upgrade(port) } else { String::new() };
        let _ = talk(server, &[begin.as_bytes(), data.get(1..).unwrap_or_default()]);
        let get = format!("GET /surface HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n");
        let answer = talk(server, &[get.as_bytes()]).unwrap();
        assert!(answer.starts_with(b"HTTP/1.1 200 OK") && answer.ends_with(&[1, 2, 3]), "{answer:?}");
        let _ = server.commands().count();
    });
}

fn talk(server: &Server, pieces: &[&[u8]]) -> std::io::Result<Vec<u8>> {
    let mut stream = TcpStream::connect(server.address())?;
    stream.set_read_timeout(Some(Duration::from_secs(10)))?;
    pieces.iter().try_for_each(|piece| stream.write_all(piece))?;
    stream.shutdown(Shutdown::Write)?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer)?;
    Ok(answer)
}

/// An external controller's socket and the gateway's side of it, with the number of the present tick.
struct Listening {
    external: ExternalController,
    client: UnixDatagram,
    skin: Skin,
    tick: u64,
    folder: TempDir,
}

impl Listening {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let skin = Skin::parse("skin.toml", include_str!("../../fuzz/seeds/skin/generated.toml")).unwrap();
        let external = ExternalController::listen(&folder.path().join("controller"), &skin).unwrap();
        let client = UnixDatagram::bind(folder.path().join("client")).unwrap();
        Self { external, client, skin, tick: 0, folder }
    }
}

/// Sends datagrams of any bytes: the robot's motion must stay finite and within its speed limits. Each datagram follows
/// its length; if that is odd, its magic and version are corrected.
pub(super) fn controller(data: &[u8]) {
    thread_local! {
        static LISTENING: RefCell<Listening> = RefCell::new(Listening::new());
    }
    LISTENING.with_borrow_mut(|listening| {
        let mut rest = data;
        while let Some((&length, behind)) = rest.split_first() {
            let (datagram, behind) = behind.split_at(usize::from(length).min(behind.len()));
            rest = behind;
            let mut datagram = datagram.to_vec();
            if length % 2 == 1 && datagram.len() >= 16 {
                datagram.splice(..6, *b"SKBC\x01\x00");
                // Only answers to the previous tick count.
                datagram.splice(8..16, listening.tick.wrapping_sub(1).to_le_bytes());
            }
            let _ = listening.client.send_to(&datagram, listening.folder.path().join("controller"));
            step(listening);
        }
    });
}

fn step(listening: &mut Listening) {
    let tick = listening.tick;
    listening.tick += 1;
    let input = ControllerInput { tick, valid: true, ..ControllerInput::default() };
    if let ControllerOutput::Move(velocities) = listening.external.step(&input) {
        let limits = listening.skin.controller.max_speed.iter().map(Some).chain(std::iter::repeat(None));
        for (velocity, limit) in velocities.iter().zip(limits) {
            let limit = limit.copied().unwrap_or(0.0);
            assert!(velocity.abs() <= limit, "{velocity} rad/s beyond {limit}");
        }
    }
    let mut state = [0; 4096];
    listening.client.set_nonblocking(true).unwrap();
    while listening.client.recv(&mut state).is_ok() {}
}
