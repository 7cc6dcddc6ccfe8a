//! Which cells of a bus something touches, as far as that is known.

use protocol::id::CellId;

type Set = [u64; CellId::COUNT.div_ceil(64)];

/// Which cells something touches.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Touched {
    touched: Set,
    known: Set,
}

impl Touched {
    /// Whether a cell is touched; none when nobody knows.
    #[must_use]
    pub fn is(&self, cell: CellId) -> Option<bool> {
        has(&self.known, cell).then(|| has(&self.touched, cell))
    }

    /// Takes in of a cell whether it is touched.
    pub fn insert(&mut self, cell: CellId, is_touched: bool) {
        insert(&mut self.known, cell);
        if is_touched {
            insert(&mut self.touched, cell);
        }
    }
}

fn has(set: &Set, cell: CellId) -> bool {
    set.get(cell.index() / 64).is_some_and(|word| word >> (cell.index() % 64) & 1 == 1)
}

fn insert(set: &mut Set, cell: CellId) {
    if let Some(word) = set.get_mut(cell.index() / 64) {
        *word |= 1 << (cell.index() % 64);
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
