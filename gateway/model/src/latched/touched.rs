//! A set of the cells of a bus that are in contact.

use protocol::id::CellId;

/// The contact of each cell of a bus: true, false, or `None` if unknown.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct KnownContacts([Option<bool>; CellId::COUNT]);

impl Default for KnownContacts {
    fn default() -> Self {
        Self([None; CellId::COUNT])
    }
}

impl KnownContacts {
    /// Returns true if a cell is in contact; `None` if unknown.
    #[must_use]
    pub fn in_contact(&self, cell: CellId) -> Option<bool> {
        self.0.get(cell.index()).copied().flatten()
    }

    /// Records the contact of a cell.
    pub fn insert(&mut self, cell: CellId, is_touched: bool) {
        if let Some(place) = self.0.get_mut(cell.index()) {
            *place = Some(is_touched);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cell_has_a_place_of_its_own() {
        let mut touched = KnownContacts::default();
        for (before, cell) in CellId::all().enumerate() {
            assert_eq!(CellId::all().filter(|cell| touched.in_contact(*cell).is_some()).count(), before);
            touched.insert(cell, before % 3 == 0);
            assert_eq!(touched.in_contact(cell), Some(before % 3 == 0));
        }
    }
}
