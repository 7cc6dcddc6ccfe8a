//! Contacts: the times in which a cell has a force.

use std::collections::BTreeMap;
use std::io;

use protocol::id::CellId;
use protocol::skin::Skin;
use trace::columns::{ColumnFolder, ColumnSpec, Element, GroupRange, GroupedTable, Row};

use super::cell_group;
use crate::explain::TorqueExplanation;

/// A contact that has not ended.
#[derive(Clone, Copy, Debug)]
struct OpenContact {
    begin_ns: u64,
    /// Time of the last joints of the bus.
    last_ns: u64,
    peak_force: Option<f64>,
}

/// The table of contacts. A contact begins with the first joints at which the cell's force is above its threshold, and
/// ends with the first ones at which it is not. If the force is unknown, an answer counts as contact unless all its
/// words are zero: a cell answers once with zeros when its contact has ended, and then no more.
#[derive(Debug)]
pub(super) struct ContactTable {
    table: GroupedTable,
    open: BTreeMap<u32, OpenContact>,
    row: Row,
}

impl ContactTable {
    pub(super) fn create(folder: &ColumnFolder) -> io::Result<Self> {
        let columns = [
            ColumnSpec::single("begin_ns", Element::I64),
            ColumnSpec::single("end_ns", Element::I64),
            ColumnSpec::single("ended", Element::Bool),
            ColumnSpec::single("peak_force", Element::F64),
        ];
        let table = GroupedTable::create(folder, "contacts", &columns)?;
        Ok(Self { table, open: BTreeMap::new(), row: Row::default() })
    }

    /// Handles the cells of an epoch.
    pub(super) fn receive_epoch(&mut self, skin: &Skin, explanation: &TorqueExplanation) -> io::Result<()> {
        let buses = explanation.buses.iter();
        let buses: Vec<_> =
            buses.filter_map(|bus| Some((&bus.bus, skin.bus_index(&bus.bus)?, bus.at_ns))).collect();
        for cell in &explanation.cells {
            let has_torque = || cell.rows.iter().any(|row| row.word.is_some_and(|word| word != 0));
            let is_active = cell.force.map_or_else(has_torque, |force| force.force_steps > 0);
            let bus = buses.iter().find(|(name, ..)| **name == cell.bus).filter(|_| is_active);
            let (Some(&(_, bus, at_ns)), Ok(node)) = (bus, CellId::new(cell.node.into())) else { continue };
            let contact = self.open.entry(cell_group(bus, node)).or_insert(OpenContact {
                begin_ns: at_ns,
                last_ns: at_ns,
                peak_force: None,
            });
            contact.last_ns = at_ns;
            let force = cell.force.map(|force| force.force_n);
            contact.peak_force = contact.peak_force.into_iter().chain(force).reduce(f64::max);
        }
        let at_of = |group: u32| {
            let of = buses.iter().find(|(_, bus, _)| u32::try_from(*bus) == Ok(group >> 8));
            of.map(|(.., at_ns)| *at_ns)
        };
        let ended =
            |group: u32, contact: &OpenContact| at_of(group).filter(|at_ns| *at_ns != contact.last_ns);
        let over: Vec<_> = self
            .open
            .iter()
            .filter_map(|(group, contact)| Some((*group, *contact, ended(*group, contact)?)))
            .collect();
        for (group, contact, end_ns) in over {
            self.open.remove(&group);
            self.push(group, contact, end_ns, true)?;
        }
        Ok(())
    }

    fn push(&mut self, group: u32, contact: OpenContact, end_ns: u64, ended: bool) -> io::Result<()> {
        let peak = contact.peak_force.unwrap_or(f64::NAN);
        self.row.clear().count(contact.begin_ns).count(end_ns).bool(ended).f64(peak);
        self.table.push(group, &self.row)
    }

    /// Finishes the table. Contacts that have not ended get the time of the last joints.
    pub(super) fn finish(mut self) -> io::Result<Vec<GroupRange>> {
        for (group, contact) in std::mem::take(&mut self.open) {
            self.push(group, contact, contact.last_ns, false)?;
        }
        self.table.finish()
    }
}
