//! Traffic of foreign buses, generated from a seed.

use protocol::can::{ERROR, EXTENDED, Frame};

/// Random numbers (SplitMix64).
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn word(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Returns a number below a bound.
    pub(crate) fn below(&mut self, bound: u64) -> u64 {
        self.word() % bound
    }
}

/// Behaviour of a message's bytes from frame to frame.
#[derive(Clone, Copy)]
enum Bytes {
    /// The bytes never change.
    Constant,
    /// A slow signal, a 4-bit counter, and a checksum over them.
    Signals,
    /// Random bytes.
    Noise,
}

/// 11-bit identifiers of a car with their periods in ms: powertrain fast, body slow. All kinds of this protocol are
/// among them: commands, sums, torques, sensors, network, configuration, stimuli.
const CAR: [(u32, u64, Bytes); 22] = [
    (0x000, 500, Bytes::Constant),
    (0x001, 10, Bytes::Signals),
    (0x002, 20, Bytes::Constant),
    (0x0C4, 10, Bytes::Signals),
    (0x0D1, 20, Bytes::Noise),
    (0x130, 10, Bytes::Signals),
    (0x1D0, 20, Bytes::Signals),
    (0x201, 10, Bytes::Signals),
    (0x20C, 10, Bytes::Noise),
    (0x2F9, 20, Bytes::Constant),
    (0x316, 10, Bytes::Signals),
    (0x329, 10, Bytes::Constant),
    (0x400, 100, Bytes::Signals),
    (0x40C, 20, Bytes::Signals),
    (0x43F, 10, Bytes::Noise),
    (0x50C, 100, Bytes::Signals),
    (0x545, 10, Bytes::Signals),
    (0x5FF, 1000, Bytes::Constant),
    (0x60C, 20, Bytes::Noise),
    (0x690, 100, Bytes::Signals),
    (0x70C, 50, Bytes::Signals),
    (0x7FF, 1000, Bytes::Constant),
];

/// Generates the 11-bit traffic of a car over `millis` ms: classic frames of 8 bytes in order of time, each with its
/// time in ns.
pub(crate) fn car(seed: u64, millis: u64) -> Vec<(u64, Frame)> {
    let mut random = Random(seed);
    let mut frames = Vec::new();
    for (place, (id, period, bytes)) in CAR.into_iter().enumerate() {
        let constant = random.word();
        let mut signal = random.below(4096);
        for (count, due) in
            (random.below(period)..millis).step_by(usize::try_from(period).unwrap()).enumerate()
        {
            signal = signal.wrapping_add(random.below(9)).wrapping_sub(4);
            let mut data = match bytes {
                Bytes::Constant => constant.to_le_bytes(),
                Bytes::Noise => random.word().to_le_bytes(),
                Bytes::Signals => ((constant & !0xFFFF) | (signal & 0xFFFF)).to_le_bytes(),
            };
            if let Bytes::Signals = bytes {
                data[6] = u8::try_from(count % 16).unwrap();
                data[7] = data[..7].iter().fold(0xFF, |sum, byte| sum ^ byte);
            }
            // Some jitter, without reordering the frames of one identifier.
            let nanos = due * 1_000_000 + random.below(400_000) + u64::try_from(place).unwrap();
            frames.push((nanos, Frame::classic(id, &data).unwrap()));
        }
    }
    frames.sort_by_key(|(nanos, _)| *nanos);
    frames
}

/// Generates other traffic of foreign buses: CAN FD, J1939, short frames, remote and error frames.
pub(crate) fn others(seed: u64, millis: u64) -> Vec<(u64, Frame)> {
    let mut random = Random(seed);
    let mut frames = Vec::new();
    let mut add = |period: u64, make: &mut dyn FnMut(u64) -> Frame| {
        for due in (random.below(period)..millis).step_by(usize::try_from(period).unwrap()) {
            frames.push((due * 1_000_000 + random.below(400_000), make(random.word())));
        }
    };
    let bytes = |word: u64| [word.to_le_bytes(), word.rotate_left(23).to_le_bytes()].concat();
    add(10, &mut |word| Frame::fd(0x20D, 1, &bytes(word)).unwrap());
    add(20, &mut |word| Frame::fd(0x300, 1, &[word.to_le_bytes(); 8].concat()).unwrap());
    // Engine speed, vehicle speed, a fault message.
    add(10, &mut |word| Frame::classic(0x0CF0_0400 | EXTENDED, &word.to_le_bytes()).unwrap());
    add(100, &mut |word| Frame::classic(0x18FE_F100 | EXTENDED, &word.to_le_bytes()).unwrap());
    add(1000, &mut |word| Frame::classic(0x18FE_CA00 | EXTENDED, &word.to_le_bytes()[..6]).unwrap());
    add(50, &mut |word| Frame::classic(0x181, &word.to_le_bytes()[..4]).unwrap());
    add(200, &mut |_| Frame::remote(0x701, 1).unwrap());
    add(500, &mut |_| Frame::classic(ERROR | 0x4, &[0, 8, 0, 0, 0, 0, 0, 0]).unwrap());
    frames.sort_by_key(|(nanos, _)| *nanos);
    frames
}
