use super::*;
use protocol::message::Answer;

const WISH: CommissionOptions = CommissionOptions { dry_run: false, verify: false };

/// Builds a skin with this number of cells at different positions.
fn skin(cells: usize) -> Skin {
    let (head, cell) = crate::testing::ONE_CELL_SKIN_TOML.split_once("[[cell]]").unwrap();
    let cells = (1..=cells)
        .map(|node| {
            cell.replace("node = 1", &format!("node = {node}")).replace("0.01,", &format!("0.0{node},"))
        })
        .map(|cell| format!("[[cell]]{cell}"));
    Skin::parse("skin.toml", &(head.to_owned() + &cells.collect::<String>())).unwrap()
}

/// Returns a commissioning that has finished listening. All cells have sent a heartbeat, and need all parameters.
fn begun(skin: &Skin) -> (Commission, Micros) {
    let mut commission = Commission::new(skin, 0, WISH, 1_000, Micros(0));
    for cell in &skin.cells {
        let state = State::default().with_joint(0);
        let page = NetworkPage::Heartbeat(Heartbeat { serial: cell.serial, state, ..Heartbeat::default() });
        let message = Message::Network { from: Node::Cell(cell.node), epoch: Epoch(0), page };
        commission.handle_message(Micros(0), &message);
    }
    let now = Micros(0) + LISTEN_TIME;
    commission.handle_time(now);
    (commission, now)
}

/// Returns the requests that are sent now: receiver, tag and content.
fn requests(commission: &mut Commission) -> Vec<(Node, u8, Request)> {
    std::iter::from_fn(|| commission.poll_transmit())
        .filter_map(|message| {
            let Message::Configure { to, tag, request } = message else { return None };
            Some((to, tag, request))
        })
        .collect()
}

/// Advances the time until requests are sent again; returns the time and the requests.
fn next_requests(commission: &mut Commission) -> (Micros, Vec<(Node, u8, Request)>) {
    loop {
        let now = commission.poll_timeout().expect("it goes on");
        commission.handle_time(now);
        let requests = requests(commission);
        if !requests.is_empty() {
            return (now, requests);
        }
    }
}

/// Lets a cell confirm a write.
fn confirm(commission: &mut Commission, now: Micros, from: CellId, tag: u8, request: Request) {
    let Request::Write { number, words } = request else { panic!("{request:?}") };
    let answer = Answer::Value { number, written: true, words };
    commission.handle_message(now, &Message::Configured { from, tag, answer });
    commission.handle_time(now);
}

#[test]
fn a_request_to_everyone_is_repeated_while_most_cells_have_not_answered() {
    let skin = skin(4);
    let (mut commission, now) = begun(&skin);
    let first = requests(&mut commission);
    let [(Node::Everyone, tag, request)] = first[..] else { panic!("{first:?}") };
    let (again, repeated) = next_requests(&mut commission);
    assert_eq!((again, &repeated), (now + BROADCAST_TIMEOUT, &first));
    for cell in &skin.cells[..2] {
        confirm(&mut commission, again, cell.node, tag, request);
    }
    let (_, next) = next_requests(&mut commission);
    let [(Node::Everyone, next_tag, other)] = next[..] else { panic!("{next:?}") };
    assert_ne!((next_tag, other), (tag, request), "the other two get requests of their own");
    assert_eq!(commission.report().repeated, 1);
}

#[test]
fn a_write_is_repeated_after_100_ms_and_a_commit_after_400() {
    let skin = skin(1);
    let cell = skin.cells[0].node;
    let (mut commission, mut now) = begun(&skin);
    let mut sent = requests(&mut commission);
    let repeated_after = |commission: &mut Commission, now, sent: &[_]| {
        let (again, repeated) = next_requests(commission);
        assert_eq!(repeated, sent);
        again.elapsed_since(now)
    };
    assert_eq!(repeated_after(&mut commission, now, &sent), Span::from_millis(100));
    now = now + Span::from_millis(100);
    loop {
        let [(Node::Cell(_), tag, request)] = sent[..] else { panic!("{sent:?}") };
        if matches!(request, Request::Write { number, .. } if number == Parameter::Commit.number()) {
            break;
        }
        confirm(&mut commission, now, cell, tag, request);
        sent = requests(&mut commission);
    }
    assert_eq!(repeated_after(&mut commission, now, &sent), Span::from_millis(400));
}

#[test]
fn other_gateways_hear_of_one_that_sends() {
    let skin = skin(1);
    let announced = |dry_run| {
        let mut commission =
            Commission::new(&skin, 0, CommissionOptions { dry_run, verify: false }, 1_000, Micros(0));
        let mut times = Vec::new();
        while let Some(now) = commission.poll_timeout().filter(|now| *now <= Micros(1_000_000)) {
            assert!(!commission.may_send() || now > Micros(0) + LISTEN_TIME);
            commission.handle_time(now);
            for message in std::iter::from_fn(|| commission.poll_transmit()) {
                let is_heartbeat = matches!(
                    message,
                    Message::Network { from: Node::Gateway, page: NetworkPage::Heartbeat(_), .. }
                );
                times.extend(is_heartbeat.then_some(now.0 / 1_000));
            }
        }
        let speaks = commission.may_send();
        commission.stop();
        assert!(!commission.may_send());
        (times, speaks)
    };
    assert_eq!(announced(false), (vec![500, 750, 1_000], true));
    assert_eq!(announced(true), (vec![], false));
}
