//! The rules of `CAN_RAW` as a table, which the embedded bus and a real kernel must follow.

use protocol::bus::Filter;
use protocol::can::{ERROR, EXTENDED, EXTENDED_MASK, Frame, REMOTE};

/// A test case: a client with subscriptions, a frame, and whether the client receives it.
#[derive(Clone, Debug)]
pub struct Case {
    /// The rule, as a sentence.
    pub what: &'static str,
    /// The client's filters.
    pub filters: Vec<Filter>,
    /// True if the client requests its own frames.
    pub own_frames: bool,
    /// True if the client requests CAN FD frames.
    pub fd: bool,
    /// The error frames that the client requests.
    pub error_mask: u32,
    /// True if the client itself sends the frame, false if another client does.
    pub from_self: bool,
    /// The frame that is sent.
    pub frame: Frame,
    /// True if the client receives the frame: once, also if several filters match.
    pub received: bool,
}

/// A datagram that a `CAN_RAW` socket must not send.
#[derive(Clone, Debug)]
pub struct Refused {
    /// The defect of the datagram.
    pub what: &'static str,
    /// True if the sender opened the bus for CAN FD.
    pub fd: bool,
    /// The bytes that the socket must refuse.
    pub datagram: Vec<u8>,
}

const EXACT_EXTENDED: u32 = EXTENDED_MASK | EXTENDED | REMOTE;

fn classic(id: u32) -> Frame {
    Frame::classic(id, &[1, 2, 3]).expect("three bytes fit")
}

fn fd(id: u32) -> Frame {
    Frame::fd(id, 1, &[7; 16]).expect("16 bytes fit")
}

fn empty(id: u32) -> Frame {
    Frame::fd(id, 0, &[]).expect("nothing fits")
}

fn remote(id: u32) -> Frame {
    Frame::remote(id, 0).expect("nothing fits")
}

/// Returns test cases for all rules, with frames that pass and frames that do not.
pub fn cases() -> Vec<Case> {
    let exact = |id| Filter { id, mask: Filter::EXACT_MASK };
    let masked = |id, mask| Filter { id, mask };
    let case = |what, filters: &[Filter], frame, received| Case {
        what,
        filters: filters.to_vec(),
        own_frames: false,
        fd: true,
        error_mask: 0,
        from_self: false,
        frame,
        received,
    };
    let all = [Filter::ALL];
    vec![
        case("no filters receive nothing", &[], classic(0x123), false),
        case("the open filter receives a classic frame", &all, classic(0x123), true),
        case("the open filter receives an FD frame", &all, fd(0x123), true),
        case("the open filter receives a 29-bit identifier", &all, classic(0x123 | EXTENDED), true),
        case("the open filter receives a remote frame", &all, remote(0x123), true),
        case("the open filter receives no error frame", &all, classic(ERROR | 1), false),
        case("an exact filter receives its identifier", &[exact(0x123)], classic(0x123), true),
        case("an exact filter receives its identifier in an FD frame", &[exact(0x123)], fd(0x123), true),
        case("an exact filter receives no other identifier", &[exact(0x123)], classic(0x122), false),
        case("an exact filter receives no remote frame", &[exact(0x123)], remote(0x123), false),
        case(
            "an exact filter of 11 bits receives none of 29",
            &[exact(0x123)],
            classic(0x123 | EXTENDED),
            false,
        ),
        case("an exact filter receives identifier 0", &[exact(0)], classic(0), true),
        case("an exact filter receives identifier 7FE", &[exact(0x7FE)], classic(0x7FE), true),
        case(
            "an exact filter of 29 bits receives its identifier",
            &[masked(0x1234_5678 | EXTENDED, EXACT_EXTENDED)],
            classic(0x1234_5678 | EXTENDED),
            true,
        ),
        case(
            "an exact filter of 29 bits receives no other identifier",
            &[masked(0x1234_5678 | EXTENDED, EXACT_EXTENDED)],
            classic(0x1234_5679 | EXTENDED),
            false,
        ),
        case(
            "an exact filter of 29 bits receives none of 11",
            &[masked(0x123 | EXTENDED, EXACT_EXTENDED)],
            classic(0x123),
            false,
        ),
        case(
            "the full mask of 29 bits with an identifier of 11 is an exact filter of 11",
            &[masked(0x123, EXACT_EXTENDED)],
            classic(0x123),
            true,
        ),
        case(
            "a mask without the extended flag matches both sizes (11)",
            &[masked(0x123, 0x7FF)],
            classic(0x123),
            true,
        ),
        case(
            "a mask without the extended flag matches both sizes (29)",
            &[masked(0x123, 0x7FF)],
            classic(0x1000_0123 | EXTENDED),
            true,
        ),
        case(
            "a mask without the remote flag matches a remote frame",
            &[masked(0x123, 0x7FF)],
            remote(0x123),
            true,
        ),
        case("a filter for remote frames receives one", &[exact(0x123 | REMOTE)], remote(0x123), true),
        case(
            "a filter for remote frames receives no data frame",
            &[exact(0x123 | REMOTE)],
            classic(0x123),
            false,
        ),
        case(
            "a mask of some bits receives what agrees in them",
            &[masked(0x200, 0x700)],
            classic(0x2FE),
            true,
        ),
        case("a mask of some bits does not receive the rest", &[masked(0x200, 0x700)], classic(0x3FE), false),
        case(
            "bits of the identifier outside the mask do not count",
            &[masked(0x2FF, 0x700)],
            classic(0x200),
            true,
        ),
        case("the second of two filters counts too", &[exact(1), exact(2)], classic(2), true),
        case("two filters receive nothing else", &[exact(1), exact(2)], classic(3), false),
        case("what two filters match comes once", &[exact(2), Filter::ALL, masked(2, 0xF)], classic(2), true),
        case("what one filter matches twice over comes once", &[exact(2), exact(2)], classic(2), true),
        case(
            "an inverted filter receives what does not match",
            &[exact(0x123).inverted()],
            classic(0x124),
            true,
        ),
        case(
            "an inverted filter does not receive what matches",
            &[exact(0x123).inverted()],
            classic(0x123),
            false,
        ),
        case(
            "an inverted filter of data frames receives the remote one",
            &[exact(0x123).inverted()],
            remote(0x123),
            true,
        ),
        case("the inverted open filter receives nothing", &[Filter::ALL.inverted()], classic(0x123), false),
        case(
            "an inverted filter receives no error frame",
            &[exact(0x123).inverted()],
            classic(ERROR | 1),
            false,
        ),
        case(
            "two inverted filters let each other's pass",
            &[exact(1).inverted(), exact(2).inverted()],
            classic(1),
            true,
        ),
        case(
            "an inverted filter and an exact one for the same receive everything",
            &[exact(0x123).inverted(), exact(0x123)],
            classic(0x123),
            true,
        ),
        case(
            "what an inverted filter and another both let pass comes once",
            &[exact(1).inverted(), exact(0x123), Filter::ALL],
            fd(0x123),
            true,
        ),
        case(
            "an inverted exact filter of 11 bits lets the same number in 29 pass",
            &[exact(0x123).inverted()],
            classic(0x123 | EXTENDED),
            true,
        ),
        Case { error_mask: 0x1, ..case("the error mask receives its class", &[], classic(ERROR | 1), true) },
        Case {
            error_mask: 0x1,
            ..case("the error mask receives no other class", &[], classic(ERROR | 2), false)
        },
        Case { error_mask: 0x1, ..case("the error mask receives no data frame", &[], classic(1), false) },
        case(
            "the error flag in a mask makes a filter of error classes",
            &[masked(0, ERROR | 0x4)],
            classic(ERROR | 0x6),
            true,
        ),
        Case {
            error_mask: 0x1,
            ..case(
                "an error frame that mask and filter match comes once",
                &[masked(0, ERROR | 1)],
                classic(ERROR | 1),
                true,
            )
        },
        Case {
            error_mask: EXTENDED_MASK,
            ..case(
                "the full error mask receives an error frame of several classes",
                &[],
                classic(ERROR | 0x8C),
                true,
            )
        },
        Case {
            error_mask: EXTENDED_MASK,
            ..case("an error frame without a class is not received", &all, classic(ERROR), false)
        },
        case("an exact filter receives no error frame", &[exact(0x4)], classic(ERROR | 0x4), false),
        case("the error flag in a filter's identifier inverts it", &[exact(0x4 | ERROR)], classic(0x5), true),
        case(
            "a filter of error classes cannot be inverted",
            &[masked(ERROR, ERROR | 0x4)],
            classic(ERROR | 0x8),
            false,
        ),
        case(
            "a filter of error classes receives no data frame",
            &[masked(0, ERROR | 0x4)],
            classic(0x4),
            false,
        ),
        Case {
            error_mask: 0x4,
            fd: false,
            ..case("a classic socket receives error frames", &all, classic(ERROR | 0x4), true)
        },
        Case {
            error_mask: 0x4,
            from_self: true,
            ..case("own error frames are not received", &all, classic(ERROR | 0x4), false)
        },
        Case {
            error_mask: 0x4,
            from_self: true,
            own_frames: true,
            ..case("own error frames are received when asked for", &[], classic(ERROR | 0x4), true)
        },
        Case { from_self: true, ..case("own frames are not received", &all, classic(0x123), false) },
        Case {
            from_self: true,
            ..case(
                "own frames are not received through an exact filter",
                &[exact(0x123)],
                classic(0x123),
                false,
            )
        },
        Case {
            from_self: true,
            own_frames: true,
            ..case(
                "own frames that several filters match come once",
                &[exact(2), Filter::ALL, exact(2)],
                fd(2),
                true,
            )
        },
        Case {
            from_self: true,
            own_frames: true,
            ..case("own frames pass inverted filters too", &[exact(2).inverted()], fd(2), false)
        },
        Case {
            from_self: true,
            own_frames: true,
            ..case("a client without filters gets no own frames", &[], classic(2), false)
        },
        Case {
            from_self: true,
            own_frames: true,
            ..case("own frames are received when asked for", &all, classic(0x123), true)
        },
        Case {
            from_self: true,
            own_frames: true,
            ..case("own frames pass the filters too", &[exact(1)], classic(0x123), false)
        },
        Case {
            own_frames: true,
            ..case("others' frames are received beside own ones", &all, classic(0x123), true)
        },
        Case { fd: false, ..case("a classic socket receives a classic frame", &all, classic(0x123), true) },
        Case { fd: false, ..case("a classic socket receives no FD frame", &all, fd(0x123), false) },
        Case {
            fd: false,
            ..case(
                "a classic socket receives no FD frame through an exact filter",
                &[exact(0x123)],
                fd(0x123),
                false,
            )
        },
        Case {
            fd: false,
            ..case("a classic socket receives no FD frame, however short", &all, empty(0x123), false)
        },
    ]
}

/// Returns all datagrams that are refused.
pub fn refused() -> Vec<Refused> {
    let sized = |what, size| Refused { what, fd: true, datagram: vec![0; size] };
    let long = |what, frame: Frame, len: u8| {
        let mut datagram = frame.to_bytes().get(..frame.byte_len()).unwrap_or_default().to_vec();
        if let Some(byte) = datagram.get_mut(4) {
            *byte = len;
        }
        Refused { what, fd: true, datagram }
    };
    vec![
        sized("one byte", 1),
        sized("one byte less than a classic frame", 15),
        sized("one byte more than a classic frame", 17),
        sized("one byte less than an FD frame", 71),
        sized("one byte more than an FD frame", 73),
        long("nine bytes in a classic frame", classic(0x123), 9),
        long("255 bytes in a classic frame", classic(0x123), 255),
        long("65 bytes in an FD frame", fd(0x123), 65),
        Refused { fd: false, ..long("an FD frame on a classic socket", fd(0x123), 16) },
    ]
}

#[test]
fn every_case_has_its_own_name() {
    let mut names: Vec<_> = cases().iter().map(|case| case.what).collect();
    names.extend(refused().iter().map(|case| case.what));
    let count = names.len();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), count);
}
