//! A table with one entry per node id.

use protocol::id::{CellId, Node};

/// One value for each node id of a bus.
#[derive(Clone, Debug)]
pub struct PerCell<T>(Box<[T]>);

impl<T: Default> Default for PerCell<T> {
    fn default() -> Self {
        Self(CellId::all().map(|_| T::default()).collect())
    }
}

impl<T> PerCell<T> {
    /// Returns the value of one cell.
    #[must_use]
    pub fn get(&self, cell: CellId) -> Option<&T> {
        self.0.get(cell.index())
    }

    /// Returns the mutable value of one cell.
    pub fn get_mut(&mut self, cell: CellId) -> Option<&mut T> {
        self.0.get_mut(cell.index())
    }

    /// Returns the values of the cells that an addressee stands for: one cell, or all.
    pub fn addressed_mut(&mut self, to: Node) -> &mut [T] {
        let places = match to {
            Node::Gateway => 0..0,
            Node::Cell(cell) => cell.index()..cell.index() + 1,
            Node::Everyone => 0..CellId::COUNT,
        };
        self.0.get_mut(places).unwrap_or_default()
    }

    /// Iterates over all values, by node id.
    pub fn iter(&self) -> impl Iterator<Item = (CellId, &T)> {
        CellId::all().zip(&self.0)
    }

    /// Iterates over all mutable values, by node id.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (CellId, &mut T)> {
        CellId::all().zip(&mut self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addressees_name_one_all_or_none() {
        let mut numbers = PerCell::<u8>::default();
        let five = CellId::new(5).unwrap();
        numbers.addressed_mut(Node::Cell(five)).iter_mut().for_each(|number| *number += 1);
        numbers.addressed_mut(Node::Everyone).iter_mut().for_each(|number| *number += 1);
        assert!(numbers.addressed_mut(Node::Gateway).is_empty());
        let twice: Vec<_> =
            numbers.iter().filter(|(_, number)| **number == 2).map(|(cell, _)| cell).collect();
        assert_eq!((twice, numbers.iter().count()), (vec![five], CellId::COUNT));
        assert_eq!(numbers.get(five), Some(&2));
    }
}
