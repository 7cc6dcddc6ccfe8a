//! Torque of every epoch as CSV.

use std::io::Write;
use std::path::Path;

use analysis::explain::series::{EpochSeriesError, EpochTorque, for_each_epoch};
use csv::{Writer, WriterBuilder};
use protocol::skin::{Skin, SkinReply};
use trace::capture::{Reader, seconds_since};

use crate::input::LossCounts;
use crate::print::comma_separated;

/// Returns true for the name of a CSV file.
pub(super) fn is_csv(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "csv")
}

/// Writes a row for each epoch. Returns the number of epochs, and the counts of unreadable and lost items.
pub(super) fn write_torque_rows(
    reader: &mut Reader,
    skin: &Skin,
    out: impl Write,
) -> Result<(u64, LossCounts), EpochSeriesError<csv::Error>> {
    let mut rows = TorqueRows { out: WriterBuilder::new().from_writer(out) };
    rows.out.write_record(csv_header(skin)).map_err(EpochSeriesError::Consumer)?;
    let mut missing = LossCounts::default();
    let done =
        for_each_epoch(reader, skin, |note| missing.count(note), |first, epoch| rows.write_row(first, epoch));
    let epochs = done?.epochs;
    rows.out.flush().map_err(|error| EpochSeriesError::Consumer(error.into()))?;
    Ok((epochs, missing))
}

/// Returns the names of the buses whose cells answer with sums, which do not contain the torques of single cells.
/// Returns `None` if there are no such buses.
pub(super) fn buses_with_sums(skin: &Skin) -> Option<String> {
    let summed = skin.buses.iter().filter(|bus| bus.reply != SkinReply::Torque).map(|bus| bus.name.clone());
    let summed: Vec<_> = summed.collect();
    (!summed.is_empty()).then(|| comma_separated(summed))
}

/// Returns the names of the columns, with units.
fn csv_header(skin: &Skin) -> Vec<String> {
    let joints = skin.robot.joints.iter().flat_map(|joint| {
        let (name, unit, torque) = (&joint.name, joint.kind.unit(), joint.kind.torque_unit());
        [
            format!("position_{name}_{unit}"),
            format!("distributed_{name}_{torque}"),
            format!("central_{name}_{torque}"),
            format!("error_{name}_{torque}"),
        ]
    });
    let first = ["time_s", "epoch"].map(str::to_owned).into_iter();
    first.chain(joints).chain(["open_cells", "saturated_cells"].map(str::to_owned)).collect()
}

/// Formats a number with all its digits, and with an exponent if it is small.
fn format_number(value: f64) -> String {
    format!("{value:?}")
}

struct TorqueRows<W: Write> {
    out: Writer<W>,
}

impl<W: Write> TorqueRows<W> {
    /// Writes a row with the torques that `skinbus explain` shows. Seconds count from `zero`, in ns since 1970.
    fn write_row(&mut self, zero: u64, epoch: &EpochTorque) -> Result<(), csv::Error> {
        let EpochTorque { at_ns, epoch, positions, torques, explanation, .. } = epoch;
        let seconds = seconds_since(zero, *at_ns);
        let mut row = vec![format!("{seconds:.9}"), epoch.to_string()];
        for (position, torque) in positions.iter().zip(torques) {
            let numbers = [*position, torque.distributed, torque.central, torque.error];
            row.extend(numbers.map(|number| number.map_or_else(String::new, format_number)));
        }
        row.extend([explanation.open_cells(), explanation.saturated_cells()].map(|cells| cells.to_string()));
        self.out.write_record(row)
    }
}
