use super::*;
use proptest::prelude::*;

proptest! {
    /// A message encodes to a packet with the same meaning. Words that a page does not use may differ.
    #[test]
    fn a_meaning_comes_back(id in 0_u16..0x800, words: [i16; MAX_JOINTS], length in 0_usize..4, epoch: u8, count: u8) {
        let words = Words::new(Length::ALL[length], words);
        let packet = Packet { id: Id::from_bits(id), words, epoch: Epoch(epoch), count };
        if let Ok(message) = Message::decode(&packet) {
            prop_assert_eq!(Message::decode(&message.encode()), Ok(message));
            prop_assert_eq!(message.encode().id, packet.id);
        }
    }
}

#[test]
fn what_cannot_be_is_refused_with_the_value() {
    let packet =
        |id, count| Packet { id: Id::from_bits(id), words: Words::default(), epoch: Epoch(0), count };
    let says = |id, count| Message::decode(&packet(id, count)).unwrap_err().to_string();
    assert_eq!(
        says(0x005, 0),
        "command 5 does not exist: use 0 halt, 1 joints, 2 sync, 3 resume or 4 report"
    );
    assert_eq!(says(0x001, 7), "command with count 7; allowed: 1 to 6");
    assert_eq!(says(0x200, 1), "torque from node 0, which is not a cell");
    assert_eq!(says(0x2FF, 1), "torque from node 255, which is not a cell");
    assert_eq!(says(0x201, 2), "torque with count 2; allowed: 1");
    assert_eq!(says(0x301, 2), "sensors page 2 does not exist");
    assert_eq!(says(0x701, 3), "stimulus page 3 does not exist");
    assert_eq!(says(0x401, 9), "network page 9 does not exist");
    assert_eq!(says(0x500, 0), "configure to node 0, which is not a cell");
}

#[test]
fn senders_and_tags_are_those_of_the_packet() {
    let from = CellId::new(7).unwrap();
    let torque = Message::Torque { from, epoch: Epoch(0), torque: [0; WORDS].into() };
    assert_eq!((torque.sender(), torque.configuration_tag()), (Some(from), None));
    let request = Request::Read { number: 3 };
    let configure = Message::Configure { to: Node::Cell(from), tag: 5, request };
    assert_eq!((configure.sender(), configure.configuration_tag()), (None, Some(5)));
    let answer = Answer::Refused { number: 3, reason: 1 };
    let configured = Message::Configured { from, tag: 6, answer };
    assert_eq!((configured.sender(), configured.configuration_tag()), (Some(from), Some(6)));
}
