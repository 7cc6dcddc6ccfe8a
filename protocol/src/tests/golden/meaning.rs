//! Parser of the comments in the golden logs, which describe a message in words and fields.

use std::collections::BTreeMap;
use std::str::FromStr;

use crate::fixed::{Q, TorqueFormat};
use crate::id::{CellId, Kind, Node};
use crate::message::{
    Answer, BaselinePage, Heartbeat, Joints, Message, MessageError, NetworkPage, PortState, PortsPage,
    ReceivedCounts, RejectedCounts, Request, SensorPage, SkinSensors, State, StimulusStart, TreePage,
};
use crate::packet::{Epoch, Length, MAX_WORDS, PacketError, WORDS, Words};
use crate::parameters::{
    Baseline, BaselineSettings, Contact, Events, LinksDown, Parameter, Parameters, Pose, ReplyKind, Row,
    RowKind, Sensing, SumSchedule,
};
use crate::port::{Hello, LinkId, NodeIdWalk, PortMessage, TreeRank};

/// A comment: a word that names the message, and `key=value` fields, all of which a test must use.
pub(crate) struct Meaning<'a> {
    text: &'a str,
    what: &'a str,
    fields: BTreeMap<&'a str, &'a str>,
}

impl<'a> Meaning<'a> {
    pub(crate) fn new(text: &'a str) -> Self {
        let mut words = text.split(' ');
        let what = words.next().unwrap();
        Self { text, what, fields: words.map(|field| field.split_once('=').expect(text)).collect() }
    }

    fn take(&mut self, key: &str) -> &'a str {
        self.fields.remove(key).unwrap_or_else(|| panic!("{}: no {key}", self.text))
    }

    fn has(&self, key: &str) -> bool {
        self.fields.contains_key(key)
    }

    fn number<T: FromStr>(&mut self, key: &str) -> T {
        let text = self.take(key);
        text.parse().unwrap_or_else(|_| panic!("{}: {key}={text}", self.text))
    }

    fn hex(&mut self, key: &str) -> u16 {
        u16::from_str_radix(self.take(key), 16).expect(self.text)
    }

    /// Parses a real number, which must be a whole number of steps of the format.
    #[expect(clippy::float_cmp, reason = "the comments hold exact decimals")]
    fn q<const F: u32>(&self, text: &str) -> Q<F> {
        let value: f64 = text.parse().expect(self.text);
        let q = Q::try_nearest(value).expect(self.text);
        assert_eq!(q.to_f64(), value, "{}: {text} is no step", self.text);
        q
    }

    fn one<const F: u32>(&mut self, key: &str) -> Q<F> {
        let text = self.take(key);
        self.q(text)
    }

    fn several<const F: u32, const N: usize>(&mut self, key: &str) -> [Q<F>; N] {
        let text = self.take(key);
        let all: Vec<_> = text.split(',').map(|text| self.q(text)).collect();
        all.try_into().unwrap_or_else(|_| panic!("{}: {key} needs {N} numbers", self.text))
    }

    /// Returns the words of a joints, torque or sum message.
    fn words_of<const F: u32>(&mut self, key: &str) -> Words {
        let text = self.take(key);
        let mut words = [0; MAX_WORDS];
        let all = text.split(',').map(|text| self.q::<F>(text).to_bits());
        let count = words.iter_mut().zip(all).map(|(word, value)| *word = value).count();
        assert_eq!(count, text.split(',').count(), "{}: too many", self.text);
        Words::new(Length::for_joints(count), words)
    }

    fn cell(&mut self, key: &str) -> CellId {
        CellId::new(self.number(key)).expect(self.text)
    }

    fn node(&mut self, key: &str) -> Node {
        match self.take(key) {
            "gateway" => Node::Gateway,
            "everyone" => Node::Everyone,
            number => Node::Cell(CellId::new(number.parse().expect(self.text)).expect(self.text)),
        }
    }

    fn epoch(&mut self) -> Epoch {
        Epoch(self.number("epoch"))
    }

    fn sensors(&mut self) -> SensorPage {
        if self.has("acceleration") {
            return SensorPage::Acceleration(self.several("acceleration"));
        }
        if self.has("zero") {
            let flags = self.take("flags");
            let [tared, touched, limited] = self.flags(flags, ["tared", "touched", "limited"]);
            return SensorPage::Baseline(BaselinePage {
                zero: self.one("zero"),
                n_per_c: self.one("n_per_c"),
                temperature: self.one("found_at"),
                tared,
                touched,
                limited,
                refused: self.number("refused"),
            });
        }
        SensorPage::Skin(SkinSensors {
            contact: self.several("contact"),
            proximity: self.one("proximity"),
            temperature: self.several("temperature"),
        })
    }

    fn state(&mut self) -> State {
        let mut bits = self.number::<u16>("joint") << 8 | self.number::<u16>("version") << 12;
        for name in self.take("state").split('+').filter(|&name| name != "none") {
            bits |= State::NAMES.iter().find(|(_, known)| *known == name).expect(name).0.0;
        }
        State(bits)
    }

    /// Parses bit numbers separated by `+`, or `none`, to a mask.
    fn bits(&mut self, key: &str) -> u8 {
        let text = self.take(key);
        text.split('+')
            .filter(|&bit| bit != "none")
            .fold(0, |bits, bit| bits | 1 << bit.parse::<u8>().unwrap())
    }

    /// Parses flags separated by `+`, or `none`; each must be one of `known`.
    fn flags<const N: usize>(&self, text: &str, known: [&str; N]) -> [bool; N] {
        let set: Vec<_> = text.split('+').filter(|&flag| flag != "none").collect();
        assert!(set.iter().all(|flag| known.contains(flag)), "{}: {text}", self.text);
        known.map(|flag| set.contains(&flag))
    }

    fn port(&mut self, key: &str) -> PortState {
        let fields: Vec<_> = self.take(key).split('/').collect();
        let &[number, port, flags] = fields.as_slice() else { panic!("{}: {key}", self.text) };
        let [hears, works, other_version] = self.flags(flags, ["hears", "works", "other-version"]);
        PortState {
            number: number.parse().unwrap(),
            port: port.parse().unwrap(),
            receives: hears,
            works,
            other_version,
        }
    }

    fn rank(&mut self) -> Option<TreeRank> {
        let (round, depth) = self.take("label").split_once('/')?;
        Some(TreeRank { round: round.parse().unwrap(), depth: depth.parse().unwrap() })
    }

    fn walk(&mut self) -> NodeIdWalk {
        NodeIdWalk { walk: self.number("walk"), first: self.number("first"), last: self.number("last") }
    }

    pub(crate) fn wire(mut self) -> (LinkId, PortMessage) {
        let link_id = LinkId { wire: self.number("wire"), back: self.number::<u8>("back") == 1 };
        let message = match self.what {
            "hello" => {
                let flags = self.take("flags");
                let [hears, up, unnumbered] = self.flags(flags, ["hears", "up", "unnumbered"]);
                PortMessage::Hello(Hello {
                    version: self.number("version"),
                    number: self.number("node_id"),
                    port: self.number("port"),
                    receives: hears,
                    is_parent: up,
                    unnumbered,
                    rank: self.rank(),
                })
            }
            "join" => PortMessage::Join,
            "grant" => PortMessage::Grant(self.rank().expect(self.text)),
            "refuse" => PortMessage::Refuse,
            "leave" => PortMessage::Leave,
            "leave_ack" => PortMessage::LeaveAck,
            "probe" => PortMessage::Probe,
            "state" => PortMessage::State(self.epoch()),
            "nack" => PortMessage::Nack(self.epoch()),
            "repair" => PortMessage::Repair(self.number("round")),
            "node_id" => PortMessage::NodeId(self.walk()),
            "result" => PortMessage::Return(self.walk()),
            _ => panic!("{}: not understood", self.text),
        };
        assert!(self.fields.is_empty(), "{}: {:?} left over", self.text, self.fields);
        (link_id, message)
    }

    fn reply(&mut self) -> ReplyKind {
        match self.take("reply") {
            "torque" => ReplyKind::Torque,
            "sum" => ReplyKind::Sum(SumSchedule {
                slot_us: self.number("slot_us"),
                deepest: self.number("deepest"),
                carry: self.number::<u8>("carry") == 1,
            }),
            _ => panic!("{}: not understood", self.text),
        }
    }

    fn sensing(&mut self) -> Sensing {
        match self.take("sensing") {
            "off" => Sensing::Off,
            "continuous" => Sensing::Continuous { period_ms: self.number("period_ms") },
            "event" => Sensing::Event,
            _ => panic!("{}: not understood", self.text),
        }
    }

    fn events(&mut self) -> Events {
        Events {
            contact: self.one("contact"),
            proximity: self.one("proximity"),
            temperature: self.one("temperature"),
            acceleration: self.one("acceleration"),
            hysteresis: self.one("hysteresis"),
        }
    }

    fn baseline(&mut self) -> Baseline {
        let kind = self.take("baseline");
        if kind == "off" {
            return Baseline::Off;
        }
        let zeroing = BaselineSettings {
            threshold: self.one("threshold"),
            hysteresis: self.one("hysteresis"),
            rate_un_per_s: self.number("rate_un_per_s"),
            limit: self.one("limit"),
            n_per_c: self.one("n_per_c"),
        };
        assert_eq!(kind, if zeroing.rate_un_per_s == 0 { "hold" } else { "follow" }, "{}", self.text);
        Baseline::On(zeroing)
    }

    /// Returns the words of a parameter, encoded with the type of that parameter.
    fn words(&mut self, number: u8) -> [i16; WORDS] {
        if self.has("words") {
            let mut words = [0; WORDS];
            for (word, text) in words.iter_mut().zip(self.take("words").split(',')) {
                *word = text.parse().expect(self.text);
            }
            return words;
        }
        let parameter = Parameter::from_number(number).expect(self.text);
        let mut all = Parameters::default();
        match parameter {
            Parameter::Mount => {
                (all.joint, all.joints) = (self.number("joint"), self.number("joints"));
                if self.has("row") {
                    (all.row, all.table_rows) = (self.number("row"), self.number("rows"));
                    all.torque_format = TorqueFormat::from_number(self.number("torque_format")).unwrap();
                }
            }
            Parameter::Pose => {
                all.pose = Pose { position: self.several("position"), normal: self.several("normal") };
            }
            Parameter::Contact => {
                all.contact = Contact {
                    alpha_c: self.one("alpha_c"),
                    alpha_p: self.one("alpha_p"),
                    contact_threshold: self.one("contact_threshold"),
                    proximity_threshold: self.one("proximity_threshold"),
                    force_threshold: self.one("force_threshold"),
                };
            }
            Parameter::Timing => all.period_us = self.number("period_us"),
            Parameter::Row(row) => {
                let named = if self.has("kind") { self.take("kind") } else { "revolute" };
                *all.rows.get_mut(usize::from(row)).unwrap() = Row {
                    kind: RowKind::ALL.into_iter().find(|kind| kind.name() == named).expect(named),
                    a: self.one("a"),
                    d: self.one("d"),
                    alpha: self.one("alpha"),
                    theta_offset: self.one("theta_offset"),
                };
            }
            Parameter::Mode => return [self.number("on"), 0, 0, 0, 0, 0],
            Parameter::Reply => return self.reply().words(),
            Parameter::Sensing => return self.sensing().words(),
            Parameter::Events => return self.events().words(),
            Parameter::LinksDown => return LinksDown { ports: self.bits("deaf") }.words(),
            Parameter::Baseline => return self.baseline().words(),
            Parameter::Tare => return [self.number("tare"), 0, 0, 0, 0, 0],
            Parameter::Commit => return [self.hex("hash").cast_signed(), 0, 0, 0, 0, 0],
            Parameter::Identity => panic!("{}: identity is given in words", self.text),
        }
        all.words(parameter)
    }

    fn network(&mut self) -> NetworkPage {
        match self.what {
            "heartbeat" => NetworkPage::Heartbeat(Heartbeat {
                serial: self.number("serial"),
                configuration: self.hex("configuration"),
                sent: self.number("sent"),
                rejected: self.number("rejected"),
                state: self.state(),
            }),
            "heard" => NetworkPage::Received(ReceivedCounts {
                joints: self.number("joints"),
                joints_late: self.number("joints_late"),
                joints_repeated: self.number("joints_repeated"),
                stimuli: self.number("stimuli"),
                stimuli_late: self.number("stimuli_late"),
                torques: self.number("torques"),
            }),
            "tree" => NetworkPage::Tree(TreePage {
                parent: match self.take("parent") {
                    "none" => None,
                    number => Some(number.parse().expect(self.text)),
                },
                parent_port: self.number("up"),
                depth: self.number("depth"),
                round: self.number("round"),
                children: self.bits("children"),
                working_ports: self.bits("works"),
                sent: self.number("sent"),
                accepted: self.number("taken"),
                dropped: self.number("dropped"),
            }),
            "ports" => NetworkPage::Ports(PortsPage {
                ports: ["port0", "port1", "port2", "port3"].map(|key| self.port(key)),
                changes: self.number("changes"),
            }),
            _ => NetworkPage::Rejected(RejectedCounts {
                length: self.number("length"),
                crc: self.number("crc"),
                foreign: self.number("foreign"),
                meaning: self.number("meaning"),
                incomplete: self.number("incomplete"),
                stimuli: self.number("stimuli"),
            }),
        }
    }

    fn configure(&mut self) -> Message {
        let (to, tag, number) = (self.node("to"), self.number("tag"), self.number("parameter"));
        let request = match self.what {
            "read" => Request::Read { number },
            _ => Request::Write { number, words: self.words(number) },
        };
        Message::Configure { to, tag, request }
    }

    fn configured(&mut self) -> Message {
        let (from, tag, number) = (self.cell("from"), self.number("tag"), self.number("parameter"));
        let answer = match self.what {
            "refusal" => Answer::Refused { number, reason: self.number("reason") },
            what => Answer::Value { number, written: what == "written", words: self.words(number) },
        };
        Message::Configured { from, tag, answer }
    }

    pub(crate) fn message(mut self) -> Message {
        let message = match self.what {
            "halt" => Message::Halt,
            "sync" => Message::Sync,
            "resume" => Message::Resume,
            "report" => Message::Report,
            "joints" => Message::Joints {
                epoch: self.epoch(),
                joints: Joints {
                    positions: self.words_of::<14>("positions").padded().map(Q::from_bits),
                    in_use: self.number("in_use"),
                },
            },
            "sum" => Message::Sum {
                from: self.cell("from"),
                epoch: self.epoch(),
                torque: self.words_of::<8>("torque"),
                count: self.number("count"),
            },
            "torque" => Message::Torque {
                from: self.cell("from"),
                epoch: self.epoch(),
                torque: self.words_of::<12>("torque"),
            },
            "sensors" => {
                Message::Sensors { from: self.cell("from"), epoch: self.epoch(), page: self.sensors() }
            }
            "heartbeat" | "heard" | "refused" | "tree" | "ports" => {
                Message::Network { from: self.node("from"), epoch: self.epoch(), page: self.network() }
            }
            "read" | "write" => self.configure(),
            "value" | "written" | "refusal" => self.configured(),
            "stimulus" => {
                let from = match self.take("from") {
                    "next" => StimulusStart::Next,
                    epoch => StimulusStart::Epoch(Epoch(epoch.parse().expect(self.text))),
                };
                Message::Stimulus { to: self.node("to"), from, page: self.sensors() }
            }
            _ => panic!("{}: not understood", self.text),
        };
        assert!(self.fields.is_empty(), "{}: {:?} left over", self.text, self.fields);
        message
    }

    /// Returns the error that a comment `bad ...` names.
    pub(crate) fn error(text: &'a str) -> Error {
        let mut meaning = Self::new(text.strip_prefix("bad ").expect(text));
        let kind = |meaning: &mut Self| {
            let name = meaning.take("kind");
            Kind::ALL.into_iter().find(|kind| kind.name() == name).expect(name)
        };
        let error = match meaning.what {
            "foreign" => Error::Packet(PacketError::Foreign),
            "length" => Error::Packet(PacketError::Length {
                expected: meaning.number("expected"),
                got: meaning.number("got"),
            }),
            "crc" => {
                Error::Packet(PacketError::Crc { expected: meaning.hex("expected"), got: meaning.hex("got") })
            }
            "command" => Error::Message(MessageError::Command(meaning.number("node"))),
            "sender" => Error::Message(MessageError::Sender {
                kind: kind(&mut meaning),
                node: meaning.number("node"),
            }),
            "addressee" => Error::Message(MessageError::Addressee {
                kind: kind(&mut meaning),
                node: meaning.number("node"),
            }),
            "page" => {
                Error::Message(MessageError::Page { kind: kind(&mut meaning), page: meaning.number("page") })
            }
            "count" => Error::Message(MessageError::Count {
                kind: kind(&mut meaning),
                got: meaning.number("got"),
                allowed: match meaning.take("allowed") {
                    "1" => "1",
                    "1-to-6" => "1 to 6",
                    "7-or-8" => "7 or 8",
                    "9-or-10" => "9 or 10",
                    "11-to-14" => "11 to 14",
                    "1-to-255-or-0-with-zeros" => "1 to 255, or 0 if all words are 0",
                    other => panic!("{text}: {other}"),
                },
            }),
            _ => panic!("{text}: not understood"),
        };
        assert!(meaning.fields.is_empty(), "{text}: {:?} left over", meaning.fields);
        error
    }
}

/// The error for a frame that does not decode to a message.
#[derive(Debug, PartialEq)]
pub(crate) enum Error {
    Packet(PacketError),
    Message(MessageError),
}
