//! A set of cells of one bus: those that something touches.

use protocol::id::CellId;

/// Cells that something touches.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Touched([u64; CellId::COUNT.div_ceil(64)]);

impl Touched {
    /// Whether this cell is one of them.
    #[must_use]
    pub fn has(&self, cell: CellId) -> bool {
        let (word, bit) = (cell.index() / 64, cell.index() % 64);
        self.0.get(word).is_some_and(|word| word >> bit & 1 == 1)
    }

    /// Adds a cell.
    pub fn insert(&mut self, cell: CellId) {
        let (word, bit) = (cell.index() / 64, cell.index() % 64);
        if let Some(word) = self.0.get_mut(word) {
            *word |= 1 << bit;
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
            assert_eq!(CellId::all().filter(|cell| touched.has(*cell)).count(), before);
            touched.insert(cell);
            assert!(touched.has(cell));
        }
    }
}
