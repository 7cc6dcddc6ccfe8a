use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use tungstenite::client::IntoClientRequest;
use tungstenite::{WebSocket, client};

use super::*;
use crate::command::ControlCommand;

const TOKEN: &str = "abcdef0123456789";
/// The time within which operations must finish that should finish at once.
const TIMEOUT: Duration = Duration::from_secs(40);

fn served(token: Option<&str>) -> Server {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let token = token.map(|token| Token::parse(token).unwrap());
    let access = PageAccess { may_act: true, may_play: false, token };
    Server::start(listener, access, "{}".to_owned(), vec![1, 2, 3]).unwrap()
}

fn connect(server: &Server) -> TcpStream {
    let stream = TcpStream::connect(server.address()).unwrap();
    stream.set_read_timeout(Some(TIMEOUT)).unwrap();
    stream
}

/// Reads until the server closes the connection.
fn rest(mut stream: TcpStream) -> String {
    let mut answer = Vec::new();
    match stream.read_to_end(&mut answer) {
        Err(error) if error.kind() != ErrorKind::ConnectionReset => panic!("{error}"),
        Ok(_) | Err(_) => String::from_utf8_lossy(&answer).into_owned(),
    }
}

fn get(server: &Server, target: &str) -> String {
    let mut stream = connect(server);
    write!(stream, "GET {target} HTTP/1.1\r\nHost: {}\r\n\r\n", server.address()).unwrap();
    rest(stream)
}

fn status(answer: &str) -> &str {
    answer.split(' ').nth(1).unwrap_or("none")
}

fn page(server: &Server, query: &str) -> Result<WebSocket<TcpStream>, u16> {
    let request = format!("ws://{}/live{query}", server.address()).into_client_request().unwrap();
    match client(request, connect(server)) {
        Ok((socket, _)) => Ok(socket),
        Err(tungstenite::HandshakeError::Failure(tungstenite::Error::Http(answer))) => {
            Err(answer.status().as_u16())
        }
        Err(error) => panic!("{error}"),
    }
}

#[test]
fn only_a_recording_has_curves_and_only_with_the_token() {
    let server = served(Some(TOKEN));
    let query = "of=lateness&from=0&to=1&count=9";
    assert_eq!(status(&get(&server, &format!("/curves?{query}&token={TOKEN}"))), "404", "a live view");
    let skin = protocol::skin::Skin::parse("ur5", include_str!("../../../examples/ur5-253.toml")).unwrap();
    server.set_recording(RecordedCurves::new(Arc::default(), skin, 0));
    assert_eq!(status(&get(&server, &format!("/curves?{query}&token={TOKEN}"))), "200");
    assert_eq!(status(&get(&server, &format!("/events?from=0&to=1&token={TOKEN}"))), "200");
    assert_eq!(status(&get(&server, &format!("/curves?{query}"))), "403");
    assert_eq!(status(&get(&server, &format!("/curves?of=all&token={TOKEN}"))), "404");
}

#[test]
fn without_the_token_only_the_code_of_the_page_is_served() {
    let server = served(Some(TOKEN));
    for query in
        ["", "?token=", "?token=abcdef0123456780", "?token=0123456789abcdef", "?other=abcdef0123456789"]
    {
        for path in ["/", "/surface", "/live", "/no-such-file"] {
            let answer = get(&server, &format!("{path}{query}"));
            assert_eq!(status(&answer), "403", "{path}{query}: {answer}");
            assert!(answer.contains("\r\n\r\n403: the token is missing or outdated: open"), "{answer}");
        }
        assert_eq!(page(&server, query).err(), Some(403), "{query}");
    }
    assert_eq!(server.counts().clients, 0);
    // The links in the page to its scripts and styles carry no token.
    for path in ["/app.js", "/style.css"] {
        assert_eq!(status(&get(&server, path)), "200", "{path}");
    }
    for path in ["/", "/surface"] {
        let answer = get(&server, &format!("{path}?token={TOKEN}"));
        assert_eq!(status(&answer), "200");
        assert!(
            answer.contains("Referrer-Policy: no-referrer") && answer.contains("Cache-Control: no-store")
        );
        assert!(!answer.contains(TOKEN), "it is in the address only");
    }
    page(&server, &format!("?token={TOKEN}")).unwrap();
}

#[test]
fn bytes_behind_a_head_do_not_change_its_answer() {
    let server = served(Some(TOKEN));
    let mut stream = connect(&server);
    let head = format!("GET /live HTTP/1.1\r\nHost: {}\r\nUpgrade: websocket\r\n\r\n", server.address());
    // A message of a page follows the head. Its own header is not UTF-8, so it is written as bytes.
    stream
        .write_all(&[head.as_bytes(), &[0x81, 0x80 | 13, 0, 0, 0, 0], br#"{"do":"halt"}"#].concat())
        .unwrap();
    assert_eq!(status(&rest(stream)), "403");
    assert_eq!(server.commands().count(), 0);
}

#[test]
fn no_command_is_lost_while_another_page_sends_more_than_fit() {
    let server = served(None);
    let count = 3 * COMMAND_QUEUE_SIZE;
    let [mut flood, mut other] = [(), ()].map(|()| page(&server, "").unwrap());
    for _ in 0..count {
        flood.send(tungstenite::Message::text(r#"{"do":"resume"}"#)).unwrap();
    }
    let give_up = Instant::now() + TIMEOUT;
    let mut taken = server.commands().count();
    assert!(taken <= COMMAND_QUEUE_SIZE, "{taken}");
    other.send(tungstenite::Message::text(r#"{"do":"halt"}"#)).unwrap();
    while taken < count + 1 {
        assert!(Instant::now() < give_up, "{taken} of {} commands", count + 1);
        taken += server.commands().count();
        thread::sleep(Duration::from_millis(1));
    }
    assert_eq!(server.counts().ignored, 0);

    other.send(tungstenite::Message::text(r#"{"do":"press","cell":1,"force_n":1}"#)).unwrap();
    // With a close, because a connection that is dropped with unread messages takes the press with it.
    other.close(None).unwrap();
    while other.read().is_ok() {}
    let mut of_other = Vec::new();
    while of_other.len() < 2 {
        assert!(Instant::now() < give_up, "{of_other:?}");
        of_other.extend(server.commands().map(|(_, command)| command));
        thread::sleep(Duration::from_millis(1));
    }
    let release = PageCommand::Control(ControlCommand::Release { cell: None });
    assert_eq!(of_other[1], release, "after the press");
}

#[test]
fn a_server_that_ends_does_not_wait_for_a_page_that_waits_for_it() {
    let server = served(None);
    let mut flood = page(&server, "").unwrap();
    for _ in 0..2 * COMMAND_QUEUE_SIZE {
        flood.send(tungstenite::Message::text(r#"{"do":"resume"}"#)).unwrap();
    }
    let give_up = Instant::now() + TIMEOUT;
    let shared = Arc::clone(&server.shared);
    // One of this test's own commands fits as long as the page has not filled the queue, after which it waits.
    let own = || shared.commands.try_send((0, PageCommand::Control(ControlCommand::Resume {})));
    let mut tried = 0;
    while own().is_ok() {
        tried += 1;
        assert!(
            tried < COMMAND_QUEUE_SIZE / 2 && Instant::now() < give_up,
            "the page does not fill the queue"
        );
        thread::sleep(Duration::from_millis(100));
    }
    drop(server);
    while flood.read().is_ok() {}
    while shared.pages.load(Ordering::Relaxed) > 0 {
        assert!(Instant::now() < give_up, "the thread of the page does not end");
        thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn a_page_without_a_token_is_served_to_anybody() {
    let server = served(None);
    assert_eq!([status(&get(&server, "/")), status(&get(&server, "/surface"))], ["200", "200"]);
    page(&server, "").unwrap();
}

#[test]
fn a_head_has_one_deadline_however_it_drips() {
    let server = served(Some(TOKEN));
    let (mut slow, mut silent, empty) = (connect(&server), connect(&server), connect(&server));
    write!(silent, "GET / HTTP/1.1\r\n").unwrap();
    write!(slow, "GET / HTTP/1.1\r\nX: ").unwrap();
    let give_up = Instant::now() + TIMEOUT;
    while slow.write_all(b"a").is_ok() {
        assert!(Instant::now() < give_up, "the server waits for a slow head");
        thread::sleep(Duration::from_millis(200));
    }
    assert!(server.counts().refused >= 1);

    let answer = rest(silent);
    assert!(answer.ends_with("408: the request took longer than 5 s\n"), "{answer}");
    assert_eq!(rest(empty), "", "a client that sent nothing gets no answer");
}

#[test]
fn clients_that_send_no_request_keep_nobody_out_who_has_the_token() {
    let server = served(Some(TOKEN));
    let beginning = |_| {
        let mut stream = connect(&server);
        // Writing may fail, because the server may already have refused the client.
        let _ = write!(stream, "GET /?token=wrong HTTP/1.1\r\nX: ");
        stream
    };
    let slow: Vec<_> = (0..400).map(beginning).collect();
    assert_eq!(status(&get(&server, &format!("/?token={TOKEN}"))), "200");
    let mut page = page(&server, &format!("?token={TOKEN}")).unwrap();
    assert_eq!(page.read().unwrap().to_text().unwrap(), "{}");
    let first = slow.into_iter().next().unwrap();
    let answer = rest(first);
    assert!(
        answer.ends_with("503: too many clients are connected without a request: try again\n"),
        "{answer}"
    );
}

#[test]
fn a_page_too_many_is_refused_in_words() {
    let server = served(Some(TOKEN));
    let query = format!("?token={TOKEN}");
    assert_eq!(status(&get(&server, &format!("/live{query}"))), "426");
    let pages: Vec<_> = (0..MAX_PAGES).map(|_| page(&server, &query).unwrap()).collect();
    assert_eq!(page(&server, &query).err(), Some(503));
    let answer = get(&server, &format!("/live{query}"));
    assert!(answer.contains("503: 16 pages are open, the maximum"), "{answer}");
    drop(pages);
    let give_up = Instant::now() + TIMEOUT;
    while page(&server, &query).is_err() {
        assert!(Instant::now() < give_up, "places become free");
        thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn what_is_no_request_is_answered_in_words() {
    let server = served(None);
    let answer_to = |text: &str| {
        let mut stream = connect(&server);
        let _ = stream.write_all(text.as_bytes());
        rest(stream)
    };
    assert_eq!(status(&answer_to("POST / HTTP/1.1\r\n\r\n")), "400");
    assert_eq!(status(&answer_to("GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n")), "403");
    assert_eq!(status(&answer_to(&format!("GET / HTTP/1.1\r\nX: {}\r\n\r\n", "x".repeat(20_000)))), "431");
    assert_eq!(status(&get(&server, "/../Cargo.toml")), "404");
}

#[test]
fn an_address_is_one_that_a_browser_opens() {
    let token = Token::parse(TOKEN).unwrap();
    for (listen, expected) in [
        ("127.0.0.1:8100", "http://127.0.0.1:8100/?token=abcdef0123456789"),
        ("0.0.0.0:8100", "http://127.0.0.1:8100/?token=abcdef0123456789"),
        ("[::]:80", "http://[::1]:80/?token=abcdef0123456789"),
    ] {
        assert_eq!(page_url(listen.parse().unwrap(), Some(&token)), expected);
    }
    assert_eq!(page_url("127.0.0.1:80".parse().unwrap(), None), "http://127.0.0.1:80/");
}
