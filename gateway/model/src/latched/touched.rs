//! Which cells of a bus something touches, as far as that is known.

use protocol::id::CellId;

/// Of each cell whether something touches it; none if that is unknown.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Touched([Option<bool>; CellId::COUNT]);

impl Default for Touched {
    fn default() -> Self {
        Self([None; CellId::COUNT])
    }
}

impl Touched {
    /// Whether a cell is touched; none if that is unknown.
    #[must_use]
    pub fn is(&self, cell: CellId) -> Option<bool> {
        self.0.get(cell.index()).copied().flatten()
    }

    /// Takes in of a cell whether it is touched.
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
        let mut touched = Touched::default();
        for (before, cell) in CellId::all().enumerate() {
            assert_eq!(CellId::all().filter(|cell| touched.is(*cell).is_some()).count(), before);
            touched.insert(cell, before % 3 == 0);
            assert_eq!(touched.is(cell), Some(before % 3 == 0));
        }
    }
}
