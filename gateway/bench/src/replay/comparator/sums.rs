//! Sums less their children: what each cell itself put into a sum, whatever the tree was.
//!
//! ```text
//!   tree pages, joints by joints ──> [Trees] ─┐
//!                                             ├─> Side: own = sum - sums of the children
//!   sums of one epoch, the last of each ──────┘        recorded and now: compare
//! ```
//!
//! A sum adds whole steps, so the difference is exact and does not depend on the tree. Two cells in the same contact
//! state may differ by one step, because rounding carries its remainder into the next value. A cell whose children are
//! not certain in an epoch is left out, and so is a sum that does not contain all its children's.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use protocol::fixed::{Q7_8, TorqueFormat};
use protocol::id::CellId;
use protocol::packet::Words;
use protocol::parameters::MAX_JOINTS;

/// Where each cell's sums go, from round to round.
#[derive(Debug, Default)]
pub(super) struct Trees(BTreeMap<CellId, VecDeque<Step>>);

/// From a round on they go there.
#[derive(Clone, Copy, Debug)]
struct Step {
    since: u64,
    /// A cell's node id, 0 for the gateway's side; none if the cell is unreachable.
    parent: Option<u8>,
}

impl Trees {
    /// Takes in where a cell's sums go from a round on, as it reports.
    pub(super) fn say(&mut self, cell: CellId, parent: Option<u8>, since: u64) {
        let steps = self.0.entry(cell).or_default();
        if steps.back().is_none_or(|last| last.parent != parent) {
            steps.push_back(Step { since, parent });
        }
    }

    /// Whether a cell's sums go anywhere, by its last report.
    pub(super) fn is_reachable(&self, cell: CellId) -> bool {
        self.0.get(&cell).and_then(VecDeque::back).is_some_and(|step| step.parent.is_some())
    }

    /// Where a cell's sums go in a round; none when that is not known.
    fn parent(&self, cell: CellId, round: u64) -> Option<Option<u8>> {
        let steps = self.0.get(&cell)?;
        steps.iter().rev().find(|step| step.since <= round).map(|step| step.parent)
    }

    /// Cells that had another parent before a round, or have one after it, with these parents. Their pages have the
    /// epoch of the last joints, which are the ones before the change or those at it. A cell between two parents
    /// sends no page; one that has lost its parent for good is not between two.
    fn affected(&self, round: u64) -> BTreeSet<CellId> {
        let mut all = BTreeSet::new();
        for (cell, steps) in &self.0 {
            let is_away = self.parent(*cell, round) == Some(None);
            if is_away && steps.back().is_some_and(|last| last.parent.is_some()) {
                all.insert(*cell);
            }
            for (before, after) in steps.iter().zip(steps.iter().skip(1)) {
                if after.since == round || after.since == round + 1 {
                    all.insert(*cell);
                    let parents = [before.parent, after.parent].into_iter().flatten();
                    all.extend(parents.filter_map(|parent| CellId::new(parent.into()).ok()));
                }
            }
        }
        all
    }

    /// Drops what was before a round.
    pub(super) fn forget_before(&mut self, round: u64) {
        for steps in self.0.values_mut() {
            // The entry before a change has the former parent.
            while steps.get(2).is_some_and(|third| third.since < round) {
                steps.pop_front();
            }
        }
    }
}

/// One cell's sum.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) struct Sum {
    pub(super) torque: Words,
    /// Cells in it.
    pub(super) count: u8,
}

/// The last sum of each cell for one epoch: the one with the most cells.
#[derive(Clone, Debug, Default)]
pub(super) struct Sums(BTreeMap<CellId, Sum>);

impl Sums {
    pub(super) fn take(&mut self, cell: CellId, sum: Sum) {
        let last = self.0.entry(cell).or_insert(sum);
        if sum.count > last.count {
            *last = sum;
        }
    }

    pub(super) fn clear(&mut self) {
        self.0.clear();
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(super) fn has(&self, cell: CellId) -> bool {
        self.0.contains_key(&cell)
    }

    /// Each cell, and how many are in its sum.
    pub(super) fn counts(&self) -> impl Iterator<Item = (CellId, u8)> {
        self.0.iter().map(|(cell, sum)| (*cell, sum.count))
    }

    pub(super) fn cells(&self) -> impl Iterator<Item = CellId> {
        self.0.keys().copied()
    }
}

/// Two cells that feel the same may differ by so many steps in a sum's word: rounding carries what it took away.
pub(super) const ROUNDING: u32 = 1;

/// What one cell put into its sum.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Own {
    /// The sum as it was sent.
    pub sum: Words,
    /// Cells in it.
    pub count: u8,
    /// The children whose sums are in it.
    pub children: Vec<CellId>,
    /// The sum minus theirs, in steps of Q7.8; none where a word is saturated.
    pub steps: [Option<i32>; MAX_JOINTS],
    /// The count minus theirs: 1 of a cell in contact, 0 of one that only forwards its children's sums.
    pub cells: i32,
}

impl Own {
    /// Whether all words are saturated.
    fn is_nothing(&self) -> bool {
        self.steps.iter().flatten().all(|step| *step == 0)
    }

    /// By how many steps its words differ from another one's, where neither is saturated.
    pub(super) fn differences(&self, other: &Self) -> impl Iterator<Item = u32> {
        let both = self.steps.iter().zip(&other.steps);
        both.filter_map(|(own, it)| Some(own.as_ref()?.abs_diff(*it.as_ref()?)))
    }
}

/// The sums of one epoch and their tree, recorded or now.
pub(super) struct Side<'a> {
    sums: &'a Sums,
    children: BTreeMap<u8, Vec<CellId>>,
    affected: BTreeSet<CellId>,
    /// Of cells that changed it: all parents that are remembered.
    parents: BTreeMap<CellId, BTreeSet<u8>>,
    /// Whether the parents of all cells are known.
    is_known: bool,
}

/// Why a sum is not compared.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Why {
    /// The cell, or one that is or was its child, was changing its parent.
    Changing,
    /// Some cell has not reported where its sums go.
    Unknown,
    /// It does not contain all its children's sums, or others than were received.
    NotTaken,
}

/// How a cell's sums compare.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Outcome {
    /// The cell itself contributed nothing then, nor now.
    Nothing,
    Equal,
    Different,
    Missing,
    Extra,
    Omitted(Why),
}

impl<'a> Side<'a> {
    pub(super) fn new(sums: &'a Sums, trees: &Trees, round: u64) -> Self {
        let mut children: BTreeMap<u8, Vec<CellId>> = BTreeMap::new();
        for cell in trees.0.keys() {
            if let Some(parent) = trees.parent(*cell, round).flatten() {
                children.entry(parent).or_default().push(*cell);
            }
        }
        let is_known = sums.cells().all(|cell| trees.parent(cell, round).is_some());
        let parents = trees.0.iter().filter(|(_, steps)| steps.len() > 1);
        let parents = parents.map(|(cell, steps)| (*cell, steps.iter().filter_map(|it| it.parent).collect()));
        Self { sums, children, affected: trees.affected(round), parents: parents.collect(), is_known }
    }

    fn children(&self, cell: CellId) -> &[CellId] {
        self.children.get(&cell.get()).map_or(&[], Vec::as_slice)
    }

    /// What a cell put into its sum; none if it sent none.
    pub(super) fn own(&self, cell: CellId) -> Option<Own> {
        let Sum { torque: sum, count } = *self.sums.0.get(&cell)?;
        let below = self.children(cell).iter().filter_map(|child| Some((*child, self.sums.0.get(child)?)));
        let (mut children, mut cells) = (Vec::new(), i32::from(count));
        let mut steps = sum.padded().map(exact);
        for (child, its) in below {
            children.push(child);
            cells -= i32::from(its.count);
            for (own, &word) in steps.iter_mut().zip(its.torque.as_slice()) {
                *own = own.zip(exact(word)).map(|(own, word)| own - word);
            }
        }
        Some(Own { sum, count, children, steps, cells })
    }

    /// Whether the remainder of a cell's sum cannot be its own contribution, by whether it was touched: then it had other
    /// children than their pages report. Where joints were sent again, sums of two times may be mixed too.
    pub(super) fn is_doubtful(&self, cell: CellId, is_touched: Option<bool>, is_mixed: bool) -> bool {
        self.own(cell).is_some_and(|own| {
            let adds = own.cells == 0 && !own.is_nothing();
            is_touched.is_some_and(|is_touched| is_touched != (own.cells > 0)) || is_mixed && adds
        })
    }

    /// Whether a cell is in contact itself.
    pub(super) fn feels(&self, cell: CellId) -> bool {
        self.own(cell).is_some_and(|own| own.cells > 0)
    }

    /// Whether a cell's sum contains the received sums of all its children: then the remainder is its own contribution.
    fn is_whole(&self, cell: CellId, other: &Self) -> bool {
        let Some(own) = self.own(cell) else { return true };
        let adds_up = match own.cells {
            // Its own contribution is in it, and that of a child of one cell is not.
            0 => own.is_nothing() || !other.feels(cell),
            1 => true,
            _ => false,
        };
        // Whether a child that is received on one side only is in this sum is unknown.
        let silent = |child: &CellId| !self.sums.has(*child) && other.feels(*child);
        adds_up && !self.children(cell).iter().any(silent)
    }

    /// Whether a cell's sum contains more than on the other side, and that is the sum of a cell which is or was its
    /// child, but by its page is not in this epoch: pages come after the change that they report. It may be in no other
    /// sum then.
    fn holds_a_mover(&self, cell: CellId, other: &Self, allowed: u32) -> bool {
        let own_of = |cell| Some((self.own(cell)?, other.own(cell)?));
        let Some((own, its)) = own_of(cell) else { return false };
        let adds = |sum: &Sum| {
            let words = own.steps.iter().zip(&its.steps).zip(sum.torque.padded());
            let mut words =
                words.filter_map(|((own, its), word)| Some(own.as_ref()? - its.as_ref()? - exact(word)?));
            own.cells - its.cells == i32::from(sum.count) && words.all(|left| left.unsigned_abs() <= allowed)
        };
        let is_elsewhere = |mover: &CellId| {
            let parent = self.children.iter().find(|(_, children)| children.contains(mover));
            let parent = parent.and_then(|(parent, _)| CellId::new(i64::from(*parent)).ok());
            parent.and_then(own_of).is_some_and(|(own, its)| own.cells >= its.cells)
        };
        self.parents.iter().any(|(mover, parents)| {
            parents.contains(&cell.get())
                && !self.children(cell).contains(mover)
                && self.sums.0.get(mover).is_some_and(|sum| sum.count > 0 && adds(sum))
                && !is_elsewhere(mover)
        })
    }

    /// The cells in a cell's sum, by the tree.
    fn below(&self, cell: CellId) -> BTreeSet<CellId> {
        let (mut all, mut next) = (BTreeSet::new(), vec![cell]);
        while let Some(cell) = next.pop() {
            if self.sums.has(cell) && all.insert(cell) {
                next.extend(self.children(cell));
            }
        }
        all
    }
}

fn exact(word: i16) -> Option<i32> {
    (!Q7_8::from_bits(word).is_saturated()).then(|| i32::from(word))
}

/// Compares what a cell put into its sums, where a torque may be so many of its steps off: that may take the rounded
/// one over one more bound. Children's differences are not in it, so however many cells are in the sum, this is enough.
pub(super) fn compare(
    recorded: &Side<'_>,
    now: &Side<'_>,
    cell: CellId,
    tolerance: u16,
    format: TorqueFormat,
) -> Outcome {
    if recorded.affected.contains(&cell) || now.affected.contains(&cell) {
        return Outcome::Omitted(Why::Changing);
    }
    if !recorded.is_known || !now.is_known {
        return Outcome::Omitted(Why::Unknown);
    }
    if !recorded.is_whole(cell, now) || !now.is_whole(cell, recorded) {
        return Outcome::Omitted(Why::NotTaken);
    }
    let (then, today) = (recorded.own(cell), now.own(cell));
    match (then, today) {
        (Some(then), Some(today)) => {
            // A word is saturated by the whole subtree: in another tree, by other cells.
            let alike = |then: i16, today: i16| {
                exact(then).is_none() == exact(today).is_none() || recorded.below(cell) != now.below(cell)
            };
            // Who only passes on what others feel has no torque that could be off.
            let finer = 1 << (format.fraction() - TorqueFormat::Q7_8.fraction());
            let tolerance = if then.cells > 0 { tolerance.div_ceil(finer) } else { 0 };
            let allowed = ROUNDING + u32::from(tolerance);
            let mut words = then
                .steps
                .iter()
                .zip(&today.steps)
                .zip(then.sum.padded().into_iter().zip(today.sum.padded()));
            let same = then.cells == today.cells
                && words.all(|((own, it), (sum, other))| match (own, it) {
                    (Some(own), Some(it)) => own.abs_diff(*it) <= allowed,
                    (None, _) | (_, None) => alike(sum, other),
                });
            if same {
                Outcome::Equal
            } else if now.holds_a_mover(cell, recorded, allowed) || recorded.holds_a_mover(cell, now, allowed)
            {
                Outcome::Omitted(Why::NotTaken)
            } else {
                Outcome::Different
            }
        }
        (Some(then), None) if then.cells > 0 => Outcome::Missing,
        (None, Some(today)) if today.cells > 0 => Outcome::Extra,
        // Whether a cell forwards others' sums depends on the tree; but it adds nothing to them.
        (Some(own), None) | (None, Some(own)) if !own.is_nothing() => Outcome::Different,
        (Some(_), None) | (None, Some(_) | None) => Outcome::Nothing,
    }
}

#[cfg(test)]
mod tests;
