//! Signals of the DBC: position in a packet, scale, unit and range.

use core::slice;

use protocol::id::Kind;
use protocol::message::State;
use protocol::packet::{Length, WORDS};
use protocol::parameters::Parameter;
use protocol::schema::{
    BusUnits, Field, FieldFormat, FieldRange, Layout, PacketSchema, parameter_layouts, refusal_reasons,
};

/// Position after the last word in a packet of six words, in bits.
const WORDS_END_BIT: usize = WORDS * 16;

/// The units and lengths of the joints, torques and sums on a bus.
#[derive(Debug)]
pub(super) struct BusChain {
    /// Number of words in a joints, torque or sum packet.
    pub(super) length: Length,
    /// Units of joints, torques and sums.
    pub(super) units: BusUnits,
    /// Number of rows of the chain's table.
    pub(super) rows: usize,
}

impl BusChain {
    /// Returns true if packets of this kind can have the page `layout` on the bus. A page for a row of the chain exists
    /// only up to the number of rows of the chain, or the minimum of a firmware image.
    fn has_page(&self, kind: Kind, layout: &Layout) -> bool {
        let is_parameter = matches!(kind, Kind::Configure | Kind::Configured);
        match Parameter::from_number(layout.number) {
            Some(parameter @ Parameter::Row(_)) if is_parameter => {
                Parameter::stored_for_rows(self.rows).any(|stored| stored == parameter)
            }
            Some(_) | None => true,
        }
    }
}

/// The packets of a message in which a signal is present.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum SignalPage {
    /// The signal is in every packet of the message.
    Every,
    /// The signal is in every packet, and is the page number that selects the others.
    Number,
    /// The signal is only in packets with this page number.
    Only(u8),
}

/// One signal of a message.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Signal {
    pub(super) name: String,
    pub(super) page: SignalPage,
    /// The first bit of the signal; bit 0 is the least significant bit of byte 0.
    pub(super) start: usize,
    pub(super) bits: u8,
    pub(super) signed: bool,
    /// The value of one step, in the unit of the signal.
    pub(super) factor: f64,
    /// The smallest and the largest valid value.
    pub(super) range: [f64; 2],
    pub(super) unit: &'static str,
    /// Names of some values, for the section `VAL_`.
    pub(super) names: Vec<(i64, &'static str)>,
}

/// Returns the signals of a kind of packet: the fields of its pages, the fields in bytes 12 and 13, and the CRC.
pub(super) fn packet_signals(schema: &'static PacketSchema, length: Length, chain: &BusChain) -> Vec<Signal> {
    let one_page = schema.layouts.len() == 1;
    // The fields after the words are further back in a longer packet.
    let further = length.words() * 16 - WORDS_END_BIT;
    let of_layout = |layout: &'static Layout| {
        let page = if one_page { SignalPage::Every } else { SignalPage::Only(layout.number) };
        layout
            .fields
            .iter()
            .flat_map(move |field| {
                let count = if field.varies_with_chain() { length.words() } else { usize::MAX };
                let signals = field_signals(field, &layout.prefix, chain.units).into_iter().take(count);
                let further = if field.first_bit() < WORDS_END_BIT { 0 } else { further };
                signals.map(move |signal| Signal { start: signal.start + further, ..signal })
            })
            .map(move |it| Signal { page, ..it })
    };
    let layouts: Vec<_> =
        schema.layouts.iter().filter(|layout| chain.has_page(schema.kind, layout)).collect();
    let mut signals: Vec<_> = layouts.iter().copied().flat_map(of_layout).collect();
    for field in &schema.end {
        let is_number = matches!(field.format, FieldFormat::Page(_) | FieldFormat::Parameter(_));
        let numbered = |signal| Signal {
            page: SignalPage::Number,
            names: layout_names(layouts.iter().copied()),
            ..signal
        };
        let signals_of = field_signals(field, "", chain.units).into_iter();
        let placed = |signal: Signal| Signal { start: signal.start + further, ..signal };
        signals
            .extend(signals_of.map(placed).map(|signal| if is_number { numbered(signal) } else { signal }));
    }
    signals.push(unsigned_signal("crc".to_owned(), length.bytes() * 8 - 16, 16));
    let words = length.words() * 16;
    signals.sort_by_key(|signal| if signal.start < words { 0 } else { signal.start });
    signals
}

/// Returns the numbers of pages or parameters, each with its name.
fn layout_names(layouts: impl IntoIterator<Item = &'static Layout>) -> Vec<(i64, &'static str)> {
    layouts.into_iter().map(|layout| (i64::from(layout.number), layout.name.as_str())).collect()
}

/// Returns an unscaled, unsigned signal.
fn unsigned_signal(name: String, start: usize, bits: u8) -> Signal {
    let max = f64::from(u32::MAX >> (32 - u32::from(bits.clamp(1, 32))));
    Signal {
        name,
        page: SignalPage::Every,
        start,
        bits,
        signed: false,
        factor: 1.0,
        range: [0.0, max],
        unit: "",
        names: Vec::new(),
    }
}

/// Returns the signals of a field: one for each element, or for a field of flags one for each named bit.
fn field_signals(field: &'static Field, prefix: &str, units: BusUnits) -> Vec<Signal> {
    let at = field.first_bit();
    let named = |label: &str| field.signal_name(prefix, label);
    if matches!(field.format, FieldFormat::Total(_)) {
        return Vec::new();
    }
    if field.format == FieldFormat::State {
        let bit = |(bit, name): (State, &str)| {
            unsigned_signal(
                format!("state_{}", name.replace('-', "_")),
                at + bit.0.trailing_zeros() as usize,
                1,
            )
        };
        let parts = [
            unsigned_signal("state_joint".to_owned(), at + 8, 4),
            unsigned_signal("state_version".to_owned(), at + 12, 4),
        ];
        return State::NAMES.into_iter().map(bit).chain(parts).collect();
    }
    if let FieldFormat::Ports(_, ports) = field.format {
        return (0..usize::from(ports))
            .map(|port| unsigned_signal(named(&port.to_string()), at + port, 1))
            .collect();
    }
    if field.labels.is_empty() {
        return vec![element_signal(field, 0, units, named(""))];
    }
    let element = |(word, label): (usize, &String)| {
        let parts =
            if let FieldFormat::Group(parts) = &field.format { &parts[..] } else { slice::from_ref(field) };
        let label = label.clone();
        let signal = move |part: &'static Field| {
            let signal = element_signal(part, word, units, part.signal_name(prefix, &label));
            Signal { start: signal.start + word * 16, ..signal }
        };
        parts.iter().map(signal)
    };
    field.labels.iter().enumerate().flat_map(element).collect()
}

/// Returns the signal of one element of a field.
fn element_signal(field: &'static Field, element: usize, units: BusUnits, name: String) -> Signal {
    let unscaled = unsigned_signal(name, field.first_bit(), field.bit_width());
    let factor = field.element_step_size(element, units);
    let signed = [i16::MIN, i16::MAX].map(|end| f64::from(end) * factor);
    let [min, max] = if field.is_signed() { signed } else { unscaled.range };
    let range = match field.range {
        FieldRange::All => [min, max],
        FieldRange::NotNegative | FieldRange::NotNegativeAtCommit => [0.0, max],
        FieldRange::Within(min, max) => [min, max].map(f64::from),
    };
    let named = |(value, name): &'static (i16, String)| (i64::from(*value), name.as_str());
    let names = if let FieldFormat::Parameter(_) = field.format {
        layout_names(parameter_layouts())
    } else if field.is_saturating() {
        [i16::MAX, i16::MIN].map(|end| (i64::from(end), "saturated")).to_vec()
    } else if field.format == FieldFormat::Reason {
        refusal_reasons().iter().map(named).collect()
    } else {
        field.names.iter().map(named).collect()
    };
    // Readers differ in the non-ASCII bytes that they accept.
    let unit = match field.element_unit(element, units) {
        "°C" => "degC",
        unit => unit,
    };
    Signal { signed: field.is_signed(), factor, range, unit, names, ..unscaled }
}
