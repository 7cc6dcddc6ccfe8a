//! Computes the values of a packet by the protocol's own types, with the signal names of the DBC, as the oracle of the
//! tests.

use std::collections::BTreeMap;

use protocol::fixed::{Q, Q1_14, Q3_12, Q7_8};
use protocol::message::{Answer, Message, NetworkPage, Request, SensorPage, State, StimulusStart};
use protocol::packet::{Packet, WORDS};
use protocol::parameters::Parameter;

/// The values of a message's signals by name, in units, from the protocol's own types.
#[derive(Default)]
struct Said(BTreeMap<String, f64>);

impl Said {
    fn put(&mut self, name: impl Into<String>, value: impl Into<f64>) {
        assert!(self.0.insert(name.into(), value.into()).is_none());
    }

    fn each<T>(&mut self, names: [&str; WORDS], values: [T; WORDS], value: impl Fn(T) -> f64) {
        for (name, of) in names.into_iter().zip(values) {
            self.put(name, value(of));
        }
    }

    fn state(&mut self, state: State) {
        for (bit, name) in State::NAMES {
            self.put(format!("state_{}", name.replace('-', "_")), u8::from(state.has(bit)));
        }
        self.put("state_joint", state.joint());
        self.put("state_version", state.version());
    }

    fn contact_state(&mut self, page: SensorPage) {
        match page {
            SensorPage::Skin(skin) => {
                self.put("page", 0);
                for (index, contact) in (1..).zip(skin.contact) {
                    self.put(format!("contact_{index}"), contact.to_f64());
                }
                self.put("proximity", skin.proximity.to_f64());
                self.put("temperature_1", skin.temperature[0].to_f64());
                self.put("temperature_2", skin.temperature[1].to_f64());
            }
            SensorPage::Acceleration(xyz) => {
                self.put("page", 1);
                for (axis, value) in ["x", "y", "z"].into_iter().zip(xyz) {
                    self.put(format!("acceleration_{axis}"), value.to_f64());
                }
            }
            SensorPage::Baseline(page) => {
                self.put("page", 3);
                self.put("baseline_zero", page.zero.to_f64());
                self.put("baseline_n_per_c", page.n_per_c.to_f64());
                self.put("baseline_found_at", page.temperature.to_f64());
                self.put("baseline_tared", u8::from(page.tared));
                self.put("baseline_touched", u8::from(page.touched));
                self.put("baseline_limited", u8::from(page.limited));
                self.put("baseline_refused", page.refused);
            }
        }
    }

    fn parameter(&mut self, number: u8, words: [i16; WORDS]) {
        self.put("parameter", number);
        let unsigned = words.map(i16::cast_unsigned);
        let q14 = |index: usize| Q1_14::from_bits(words[index]);
        let newtons = |index: usize| Q::<10>::from_bits(words[index]).to_f64();
        match Parameter::from_number(number) {
            None => {}
            Some(Parameter::Identity) => {
                self.put("serial", u32::from(unsigned[0]) + (u32::from(unsigned[1]) << 16));
                self.put("version", unsigned[2]);
                self.put("configuration", unsigned[3]);
                self.state(State(unsigned[4]));
                let abilities = unsigned[5];
                self.put("max_joints", abilities & 0xF);
                self.put("max_rows", abilities >> 4 & 0x3F);
                for (bit, name) in (10..).zip(["prismatic", "fixed", "q5_10", "q7_8"]) {
                    self.put(name, abilities >> bit & 1);
                }
            }
            Some(Parameter::Mount) => {
                self.put("mount_joint", words[0]);
                self.put("mount_joints", words[1]);
                self.put("mount_row", words[2]);
                self.put("mount_rows", words[3]);
                self.put("mount_torque_format", words[4]);
            }
            Some(Parameter::Pose) => {
                let names = ["pose_x", "pose_y", "pose_z", "normal_x", "normal_y", "normal_z"];
                self.each(names, words.map(Q1_14::from_bits), Q::to_f64);
            }
            Some(Parameter::Contact) => {
                self.put("alpha_c", Q::<12>::from_bits(words[0]).to_f64());
                self.put("alpha_p", newtons(1));
                self.put("contact_threshold", newtons(2));
                self.put("proximity_threshold", q14(3).to_f64());
                self.put("force_threshold", newtons(4));
            }
            Some(Parameter::Timing) => self.put("period", unsigned[0]),
            Some(Parameter::Mode) => self.put("mode", words[0]),
            Some(Parameter::Reply) => {
                self.put("reply", words[0]);
                self.put("reply_slot", unsigned[1]);
                self.put("reply_deepest", words[2]);
                self.put("reply_carry", words[3]);
            }
            Some(Parameter::Sensing) => {
                self.put("sensing", words[0]);
                self.put("sensing_period", unsigned[1]);
            }
            Some(Parameter::Events) => {
                self.put("events_contact", newtons(0));
                self.put("events_proximity", q14(1).to_f64());
                self.put("events_temperature", Q::<6>::from_bits(words[2]).to_f64());
                self.put("events_acceleration", Q::<12>::from_bits(words[3]).to_f64());
                self.put("events_hysteresis", q14(4).to_f64());
            }
            Some(Parameter::LinksDown) => {
                for port in 0..5 {
                    self.put(format!("link_down_port_{port}"), words[0] >> port & 1);
                }
            }
            Some(Parameter::Baseline) => {
                self.put("baseline", words[0]);
                self.put("baseline_threshold", newtons(1));
                self.put("baseline_hysteresis", q14(2).to_f64());
                self.put("baseline_rate_un_per_s", unsigned[3]);
                self.put("baseline_limit", newtons(4));
                self.put("baseline_n_per_c", q14(5).to_f64());
            }
            Some(Parameter::Tare) => self.put("tare", words[0]),
            Some(Parameter::Row(row)) => {
                let row = row + 1;
                self.put(format!("row{row}_a"), q14(0).to_f64());
                self.put(format!("row{row}_d"), q14(1).to_f64());
                self.put(format!("row{row}_alpha"), q14(2).to_radians());
                self.put(format!("row{row}_theta_offset"), q14(3).to_radians());
                self.put(format!("row{row}_kind"), words[4]);
            }
            Some(Parameter::Commit) => self.put("commit_hash", unsigned[0]),
        }
    }
}

/// Returns the DBC name of a message, and its values by the protocol's own types; `None` for a message that cannot be
/// encoded.
pub(super) fn by_protocol(message: &Message, packet: &Packet) -> (String, BTreeMap<String, f64>) {
    let mut said = Said::default();
    let crc = u16::from_le_bytes(*packet.encode().last_chunk().unwrap());
    said.put("crc", crc);
    let words = packet.words.as_slice();
    let each = |said: &mut Said, name: &str, real: &dyn Fn(i16) -> f64| {
        for (index, &word) in words.iter().enumerate() {
            said.put(format!("{name}_{}", index + 1), real(word));
        }
    };
    let name = match *message {
        Message::Halt => "halt".to_owned(),
        Message::Sync => "sync".to_owned(),
        Message::Resume => "resume".to_owned(),
        Message::Report => "report".to_owned(),
        Message::Joints { epoch, joints } => {
            said.put("epoch", epoch.0);
            said.put("count", joints.in_use);
            each(&mut said, "position", &|word| Q1_14::from_bits(word).to_radians());
            "joints".to_owned()
        }
        Message::Sum { from, epoch, count, .. } => {
            said.put("epoch", epoch.0);
            said.put("count", count);
            each(&mut said, "sum", &|word| Q7_8::from_bits(word).to_f64());
            format!("sum_{from}")
        }
        Message::Torque { from, epoch, .. } => {
            said.put("epoch", epoch.0);
            said.put("count", 1);
            each(&mut said, "torque", &|word| Q3_12::from_bits(word).to_f64());
            format!("torque_{from}")
        }
        Message::Sensors { from, epoch, page } => {
            said.put("epoch", epoch.0);
            said.contact_state(page);
            format!("sensors_{from}")
        }
        Message::Network { from, epoch, page } => {
            said.put("epoch", epoch.0);
            match page {
                NetworkPage::Heartbeat(heartbeat) => {
                    said.put("page", 0);
                    said.put("serial", heartbeat.serial);
                    said.put("configuration", heartbeat.configuration);
                    said.put("sent", heartbeat.sent);
                    said.put("rejected", heartbeat.rejected);
                    said.state(heartbeat.state);
                }
                NetworkPage::Received(heard) => {
                    said.put("page", 1);
                    said.put("heard_joints", heard.joints);
                    said.put("heard_joints_skipped", heard.joints_late);
                    said.put("heard_joints_repeated", heard.joints_repeated);
                    said.put("heard_stimuli", heard.stimuli);
                    said.put("heard_stimuli_late", heard.stimuli_late);
                    said.put("heard_torques", heard.torques);
                }
                NetworkPage::Rejected(refused) => {
                    said.put("page", 2);
                    said.put("refused_length", refused.length);
                    said.put("refused_crc", refused.crc);
                    said.put("refused_foreign", refused.foreign);
                    said.put("refused_meaning", refused.meaning);
                    said.put("refused_incomplete", refused.incomplete);
                    said.put("refused_stimuli", refused.stimuli);
                }
                NetworkPage::Tree(tree) => {
                    said.put("page", 3);
                    said.put("parent", tree.parent.unwrap_or(255));
                    said.put("up", tree.parent_port);
                    said.put("depth", tree.depth);
                    said.put("round", tree.round);
                    for port in 0..4 {
                        said.put(format!("child_at_{port}"), tree.children >> port & 1);
                    }
                    for port in 0..5 {
                        said.put(format!("port_{port}_works"), tree.working_ports >> port & 1);
                    }
                    said.put("sums_sent", tree.sent);
                    said.put("sums_taken", tree.accepted);
                    said.put("sums_dropped", tree.dropped);
                }
                NetworkPage::Ports(ports) => {
                    said.put("page", 4);
                    for (index, port) in ports.ports.into_iter().enumerate() {
                        said.put(format!("port_{index}_leads_to"), port.number);
                        said.put(format!("port_{index}_leads_to_port"), port.port);
                        said.put(format!("port_{index}_hears"), u8::from(port.receives));
                        said.put(format!("port_{index}_both_ways"), u8::from(port.works));
                        said.put(format!("port_{index}_other_version"), u8::from(port.other_version));
                    }
                    said.put("parent_changes", ports.changes);
                }
            }
            format!("network_{from}")
        }
        Message::Configure { to, tag, request } => {
            said.put("tag", tag);
            let (number, words) = match request {
                Request::Read { number } => (number, [0; WORDS]),
                Request::Write { number, words } => (number, words),
            };
            said.put("write", u8::from(matches!(request, Request::Write { .. })));
            said.parameter(number, words);
            format!("configure_{to}")
        }
        Message::Configured { from, tag, answer } => {
            said.put("tag", tag);
            match answer {
                Answer::Value { number, written, words } => {
                    said.put("written", u8::from(written));
                    said.parameter(number, words);
                }
                Answer::Refused { number, reason } => {
                    said.put("written", 0);
                    said.put("parameter", 126);
                    said.put("refused_parameter", number);
                    said.put("refused_reason", reason);
                }
            }
            format!("configured_{from}")
        }
        Message::Stimulus { to, from, page } => {
            said.put("epoch", if let StimulusStart::Epoch(epoch) = from { epoch.0 } else { 0 });
            said.put("from_next", u8::from(from == StimulusStart::Next));
            said.contact_state(page);
            format!("stimulus_{to}")
        }
    };
    (name, said.0)
}
