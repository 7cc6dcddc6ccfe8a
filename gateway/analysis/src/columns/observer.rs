//! Writes all tables while a capture is read epoch by epoch.

use std::collections::{BTreeMap, HashSet};
use std::io;

use protocol::candump::Record;
use protocol::message::Message;
use protocol::skin::Skin;
use thiserror::Error;
use trace::capture::{CaptureNote, Reader};
use trace::columns::{ColumnFolder, ColumnSpec, Element, GroupedTable, Row, Table};

use super::accounts::{Accounts, CaptureAccount};
use super::cell_group;
use super::contacts::ContactTable;
use super::description::{ColumnOrigin, TableFacts, describe};
use super::entries::{FrameTable, NoteTable};
use crate::explain::JointsNotFound;
use crate::explain::series::{EpochSeriesError, EpochTorque, KnownTorque, SeriesObserver, observe_epochs};

/// The error of writing the columns of a capture.
#[derive(Debug, Error)]
pub enum ColumnError {
    /// The capture cannot be read, or does not fit the skin.
    #[error("{0}")]
    Capture(EpochSeriesError<io::Error>),
    /// A file of the columns cannot be written.
    #[error(transparent)]
    Write(#[from] io::Error),
}

/// The tables of a capture, complete except for their description.
#[derive(Debug)]
pub struct WrittenColumns {
    /// The counts of the capture.
    pub accounts: CaptureAccount,
    folder: ColumnFolder,
    tables: BTreeMap<&'static str, TableFacts>,
    began_ns: u64,
}

/// Reads a capture to its end and writes its tables into a folder, in bounded memory.
///
/// # Errors
/// Returns [`ColumnError`] if the capture cannot be read or does not fit the skin, or if a file cannot be written.
pub fn write_columns(
    reader: &mut Reader,
    skin: &Skin,
    folder: ColumnFolder,
) -> Result<WrittenColumns, ColumnError> {
    let mut observer = ColumnObserver::new(skin, &folder)?;
    match observe_epochs(reader, skin, &mut observer) {
        Ok(_) => {}
        // Frames without joints have no epochs, but the skin may be that of the capture.
        Err(EpochSeriesError::NotFound { source: JointsNotFound::Joints { .. }, .. }) => {}
        Err(EpochSeriesError::NotFound { .. }) if observer.accounts.total.frames == 0 => {}
        Err(EpochSeriesError::Consumer(error)) => return Err(error.into()),
        Err(error) => return Err(ColumnError::Capture(error)),
    }
    let began_ns = reader.extras().run_began().or(observer.first_ns).unwrap_or_default();
    let (tables, accounts) = observer.finish()?;
    Ok(WrittenColumns { accounts, folder, tables, began_ns })
}

impl WrittenColumns {
    /// Writes the description, and gives the folder its name.
    ///
    /// # Errors
    /// Returns an error if the file system refuses.
    pub fn finish(self, origin: &ColumnOrigin<'_>, skin: &Skin, reader: &Reader) -> io::Result<()> {
        let text = describe(origin, skin, reader.extras(), self.began_ns, &self.tables, &self.accounts)?;
        self.folder.finish(&text)
    }
}

struct ColumnObserver<'a> {
    skin: &'a Skin,
    /// The groups of the skin's cells.
    cells: HashSet<u32>,
    /// Number of joints of the longest chain.
    width: usize,
    accounts: Accounts,
    first_ns: Option<u64>,
    frames: FrameTable,
    notes: NoteTable,
    joints: GroupedTable,
    torques: GroupedTable,
    sums: GroupedTable,
    epochs: Table,
    contacts: ContactTable,
    row: Row,
}

impl<'a> ColumnObserver<'a> {
    fn new(skin: &'a Skin, folder: &ColumnFolder) -> io::Result<Self> {
        let chains = (0..skin.buses.len()).map(|bus| skin.joints_on_bus(bus).len());
        let width = chains.max().unwrap_or_default();
        let robot = skin.robot.joints.len();
        let single = ColumnSpec::single;
        let joints = [
            single("at_ns", Element::I64),
            single("epoch_row", Element::I64),
            single("epoch", Element::U8),
            single("halted", Element::Bool),
            ColumnSpec::wide("words", Element::I16, width),
            ColumnSpec::wide("positions", Element::F64, width),
        ];
        let torques = [
            single("at_ns", Element::I64),
            single("joints_row", Element::I64),
            single("epoch", Element::U8),
            ColumnSpec::wide("words", Element::I16, width),
        ];
        let sums = [
            single("at_ns", Element::I64),
            single("epoch", Element::U8),
            single("count", Element::U8),
            ColumnSpec::wide("words", Element::I16, width),
        ];
        let epochs = [
            single("at_ns", Element::I64),
            single("number", Element::I64),
            single("epoch", Element::U8),
            single("open_cells", Element::U32),
            single("saturated_cells", Element::U32),
            ColumnSpec::wide("positions", Element::F64, robot),
            ColumnSpec::wide("distributed", Element::F64, robot),
            ColumnSpec::wide("central", Element::F64, robot),
            ColumnSpec::wide("error", Element::F64, robot),
        ];
        Ok(Self {
            skin,
            cells: skin.cells.iter().map(|cell| cell_group(cell.bus, cell.node)).collect(),
            width,
            accounts: Accounts::new(skin.buses.iter().map(|bus| bus.name.as_str())),
            first_ns: None,
            frames: FrameTable::create(folder)?,
            notes: NoteTable::create(folder)?,
            joints: GroupedTable::create(folder, "joints", &joints)?,
            torques: GroupedTable::create(folder, "torques", &torques)?,
            sums: GroupedTable::create(folder, "sums", &sums)?,
            epochs: Table::create(folder, "epochs", &epochs)?,
            contacts: ContactTable::create(folder)?,
            row: Row::default(),
        })
    }

    fn bus_number(&mut self, name: &str) -> io::Result<(usize, i16)> {
        let index = self.accounts.bus_index(name);
        let number = i16::try_from(index).map_err(|_| {
            io::Error::other(format!(
                "the capture has more than {} buses, which columns cannot hold: convert fewer files at once",
                i16::MAX
            ))
        })?;
        Ok((index, number))
    }

    fn finish(self) -> io::Result<(BTreeMap<&'static str, TableFacts>, CaptureAccount)> {
        let epochs = self.epochs.rows();
        let tables = [
            ("frames", TableFacts::with_rows(self.frames.finish()?)),
            ("notes", TableFacts::with_rows(self.notes.finish()?)),
            ("joints", TableFacts::with_groups(&self.joints.finish()?)),
            ("torques", TableFacts::with_groups(&self.torques.finish()?)),
            ("sums", TableFacts::with_groups(&self.sums.finish()?)),
            ("epochs", TableFacts::with_rows(self.epochs.finish()?)),
            ("contacts", TableFacts::with_groups(&self.contacts.finish()?)),
        ];
        Ok((tables.into(), self.accounts.finish(epochs)))
    }
}

impl SeriesObserver for ColumnObserver<'_> {
    type Error = io::Error;

    fn receive_frame(
        &mut self,
        record: &Record<'_>,
        message: Option<&Message>,
        answered: Option<u64>,
    ) -> io::Result<()> {
        let at_ns = record.time.nanos;
        self.first_ns.get_or_insert(at_ns);
        let (bus, number) = self.bus_number(record.interface)?;
        self.frames.push(number, record)?;
        let is_of_skin = bus < self.skin.buses.len();
        let sender = message.and_then(Message::sender).map(|sender| cell_group(bus, sender));
        // Only cells of the skin are part of the torques of an epoch.
        let answered = answered.filter(|_| sender.is_some_and(|sender| self.cells.contains(&sender)));
        self.accounts.count_frame(bus, message, answered.is_some(), is_of_skin);
        let Some(sender) = sender.filter(|_| is_of_skin) else { return Ok(()) };
        match message {
            Some(Message::Torque { epoch, torque, .. }) => {
                let joints_row = answered.map_or(-1, |row| i64::try_from(row).unwrap_or(-1));
                self.row.clear().count(at_ns).i64(joints_row).u8(epoch.0);
                self.row.words(torque.as_slice(), self.width);
                self.torques.push(sender, &self.row)
            }
            Some(Message::Sum { epoch, torque, count, .. }) => {
                self.row.clear().count(at_ns).u8(epoch.0).u8(*count);
                self.row.words(torque.as_slice(), self.width);
                self.sums.push(sender, &self.row)
            }
            _ => Ok(()),
        }
    }

    fn receive_note(&mut self, note: &CaptureNote<'_>) -> io::Result<()> {
        let about = (!note.interface.is_empty()).then_some(note.interface);
        let bus = about.map(|name| self.bus_number(name)).transpose()?;
        self.accounts.count_note(note, bus.map(|(index, _)| index));
        self.notes.push(bus.map_or(-1, |(_, number)| number), note)
    }

    fn receive_epoch(&mut self, _: u64, epoch: &EpochTorque) -> io::Result<()> {
        let EpochTorque { at_ns, epoch, number, positions, torques, explanation } = epoch;
        let of_epoch = self.epochs.rows();
        for bus in &explanation.buses {
            let Some(index) = self.skin.bus_index(&bus.bus) else { continue };
            self.row.clear().count(bus.at_ns).count(of_epoch).u8(*epoch).bool(bus.halted);
            self.row.words(&bus.position_words, self.width);
            self.row.numbers(bus.position_rad.iter().copied(), self.width);
            self.joints.push(u32::try_from(index).unwrap_or(u32::MAX >> 8) << 8, &self.row)?;
        }
        let robot = self.skin.robot.joints.len();
        self.row.clear().count(*at_ns).i64(*number).u8(*epoch);
        for cells in [explanation.open_cells(), explanation.saturated_cells()] {
            self.row.u32(u32::try_from(cells).unwrap_or(u32::MAX));
        }
        self.row.numbers(positions.iter().map(|position| position.unwrap_or(f64::NAN)), robot);
        let parts: [fn(&KnownTorque) -> Option<f64>; 3] =
            [|torque| torque.distributed, |torque| torque.central, |torque| torque.error];
        for part in parts {
            self.row.numbers(torques.iter().map(|torque| part(torque).unwrap_or(f64::NAN)), robot);
        }
        self.epochs.push(&self.row)?;
        self.contacts.receive_epoch(self.skin, explanation)
    }
}
