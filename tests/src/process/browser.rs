//! A headless Chromium, controlled by the DevTools protocol.
#![allow(
    dead_code,
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "each test file uses its part of it, and a test may stop"
)]

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tempfile::TempDir;
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket, client};

use crate::process::TIMEOUT;

/// A page in a browser process of its own.
pub struct Browser {
    _process: Process,
    _profile: TempDir,
    socket: WebSocket<TcpStream>,
    number: u64,
    /// The events that the browser has reported.
    pub events: Vec<Value>,
}

/// The browser's process, which ends when this value is dropped.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Browser {
    /// Opens an empty page of this size.
    pub fn new(width: u32, height: u32) -> Self {
        let profile = TempDir::new().unwrap();
        let mut child = Command::new("chromium")
            .args(["--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run"])
            .args(["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"])
            .args([
                "--disable-background-networking",
                "--disable-component-update",
                "--disable-sync",
                "--disable-quic",
            ])
            .arg(format!("--window-size={width},{height}"))
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .args(["--remote-debugging-port=0", "about:blank"])
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("chromium is missing: tests/tools/install makes it ready");
        let stderr = child.stderr.take().unwrap();
        // From here on the process ends with this value, whatever fails.
        let process = Process(child);
        let mut lines = BufReader::new(stderr).lines();
        let said = lines
            .find_map(|line| line.unwrap().strip_prefix("DevTools listening on ws://").map(str::to_owned));
        // Its further output must not fill the pipe.
        std::thread::spawn(move || lines.for_each(drop));
        let address = said.expect("the browser ended").split('/').next().unwrap().to_owned();
        let socket = connect(&page(&address));
        let mut browser =
            Self { _process: process, _profile: profile, socket, number: 0, events: Vec::new() };
        for domain in ["Runtime", "Log", "Network", "Page"] {
            browser.call(&format!("{domain}.enable"), &json!({}));
        }
        browser.resize(width, height);
        browser
    }

    pub fn resize(&mut self, width: u32, height: u32) {
        let metrics =
            json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600 });
        self.call("Emulation.setDeviceMetricsOverride", &metrics);
    }

    /// Selects the light or the dark scheme.
    pub fn scheme(&mut self, scheme: &str) {
        let feature = json!({ "features": [{ "name": "prefers-color-scheme", "value": scheme }] });
        self.call("Emulation.setEmulatedMedia", &feature);
    }

    pub fn open(&mut self, url: &str) {
        self.call("Page.navigate", &json!({ "url": url }));
    }

    /// Calls a method of the DevTools protocol, and returns its result.
    pub fn call(&mut self, method: &str, parameters: &Value) -> Value {
        let answer = self.try_call(method, parameters);
        assert!(answer["error"].is_null(), "{method}: {answer}");
        answer["result"].clone()
    }

    /// Calls a method that may fail, for example because its element does not exist any more. Returns the answer.
    pub fn try_call(&mut self, method: &str, parameters: &Value) -> Value {
        self.number += 1;
        let message = json!({ "id": self.number, "method": method, "params": parameters });
        self.socket.send(Message::text(message.to_string())).unwrap();
        loop {
            let Message::Text(text) = self.socket.read().unwrap() else { continue };
            let answer: Value = serde_json::from_str(text.as_str()).unwrap();
            if answer["id"] == self.number {
                return answer;
            }
            self.events.push(answer);
        }
    }

    /// Returns the value of a JavaScript expression on the page.
    pub fn value(&mut self, expression: &str) -> Value {
        let result =
            self.call("Runtime.evaluate", &json!({ "expression": expression, "returnByValue": true }));
        assert!(result["exceptionDetails"].is_null(), "{expression}: {result}");
        result["result"]["value"].clone()
    }

    /// Waits until a JavaScript expression is true or has a value, and returns that value.
    pub fn until(&mut self, expression: &str) -> Value {
        let give_up = Instant::now() + TIMEOUT;
        loop {
            let value = self.value(expression);
            if !value.is_null() && value != false {
                return value;
            }
            assert!(Instant::now() < give_up, "not true after {TIMEOUT:?}: {expression}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Moves, presses or releases the left button of the mouse.
    pub fn mouse(&mut self, kind: &str, [x, y]: [f64; 2]) {
        let buttons = i32::from(kind != "mouseReleased");
        let event =
            json!({ "type": kind, "x": x, "y": y, "button": "left", "buttons": buttons, "clickCount": 1 });
        self.call("Input.dispatchMouseEvent", &event);
    }

    pub fn key(&mut self, kind: &str, key: &str) {
        self.call("Input.dispatchKeyEvent", &json!({ "type": kind, "key": key }));
    }

    /// Returns the exceptions and console messages of the page, including violations of its content security policy.
    pub fn complaints(&self) -> Vec<&Value> {
        let is_one = |event: &&Value| {
            event["method"] == "Runtime.exceptionThrown" || event["method"] == "Log.entryAdded"
        };
        self.events.iter().filter(is_one).collect()
    }

    /// Returns the URLs that the page requested.
    pub fn requests(&self) -> Vec<&str> {
        let sent = self.events.iter().filter(|event| event["method"] == "Network.requestWillBeSent");
        sent.filter_map(|event| event["params"]["request"]["url"].as_str()).collect()
    }
}

fn connect(url: &str) -> WebSocket<TcpStream> {
    let request = url.into_client_request().unwrap();
    let stream = TcpStream::connect(request.uri().authority().unwrap().as_str()).unwrap();
    stream.set_read_timeout(Some(TIMEOUT)).unwrap();
    client(request, stream).unwrap().0
}

/// Returns the address of the browser's only page.
fn page(address: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(TIMEOUT)).unwrap();
    write!(stream, "GET /json HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
    // The connection stays open after the answer.
    let (mut answer, mut piece) = (Vec::new(), [0; 4096]);
    let pages: Value = loop {
        let read = stream.read(&mut piece).unwrap();
        assert!(read > 0, "the browser closed the connection");
        answer.extend(&piece[..read]);
        let body = str::from_utf8(&answer).unwrap().split_once("\r\n\r\n").map(|(_, body)| body);
        if let Some(pages) = body.and_then(|body| serde_json::from_str(body).ok()) {
            break pages;
        }
    };
    let page = pages.as_array().unwrap().iter().find(|page| page["type"] == "page").unwrap();
    page["webSocketDebuggerUrl"].as_str().unwrap().to_owned()
}
