//! A cell's own contribution to a sum: the sum minus the sums of the cell's children, which is independent of the tree.
//!
//! ```text
//!   tree pages, joints by joints ──> [ParentHistory] ─┐
//!                                                     ├─> EpochSums: own = sum - sums of the children
//!   sums of one epoch, the last of each ──────────────┘        recorded and now: compare
//! ```
//!
//! A sum adds whole steps, so the difference is exact and does not depend on the tree. Two cells in the same contact
//! state may differ by one step, because rounding carries its remainder into the next value. The comparison omits cells
//! whose children are uncertain in an epoch, and sums that do not contain the sums of all children.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use protocol::fixed::{Q7_8, TorqueFormat};
use protocol::id::CellId;
use protocol::packet::Words;
use protocol::parameters::MAX_JOINTS;

/// The parent of each cell, as it changes from round to round.
#[derive(Debug, Default)]
pub(super) struct ParentHistory(BTreeMap<CellId, VecDeque<ParentChange>>);

/// A change of a cell's parent.
#[derive(Clone, Copy, Debug)]
struct ParentChange {
    since: u64,
    /// Node id of the parent; 0 for the gateway's side, or `None` if the cell is unreachable.
    parent: Option<u8>,
}

impl ParentHistory {
    /// Sets the parent that a cell reports, from round `since` on.
    pub(super) fn set_parent(&mut self, cell: CellId, parent: Option<u8>, since: u64) {
        let steps = self.0.entry(cell).or_default();
        if steps.back().is_none_or(|last| last.parent != parent) {
            steps.push_back(ParentChange { since, parent });
        }
    }

    /// Returns true if the cell has a parent by its last report.
    pub(super) fn is_reachable(&self, cell: CellId) -> bool {
        self.0.get(&cell).and_then(VecDeque::back).is_some_and(|step| step.parent.is_some())
    }

    /// Returns the parent of a cell in a round, or `None` if it is unknown.
    fn parent_in_round(&self, cell: CellId, round: u64) -> Option<Option<u8>> {
        let steps = self.0.get(&cell)?;
        steps.iter().rev().find(|step| step.since <= round).map(|step| step.parent)
    }

    /// Returns the cells that may have changed their parent in this round, and their parents before and after the
    /// change. A page with the new parent carries the epoch of the last joints, so the change is at those joints or the
    /// next. A cell between two parents sends no page; a cell that has lost its parent for good is not included.
    fn cells_changing_parent(&self, round: u64) -> BTreeSet<CellId> {
        let mut all = BTreeSet::new();
        for (cell, steps) in &self.0 {
            let is_away = self.parent_in_round(*cell, round) == Some(None);
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

    /// Drops changes of parents from before a round.
    pub(super) fn forget_changes_before(&mut self, round: u64) {
        for steps in self.0.values_mut() {
            // The entry before a change holds the former parent.
            while steps.get(2).is_some_and(|third| third.since < round) {
                steps.pop_front();
            }
        }
    }
}

/// The sum that one cell sent.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) struct CellSum {
    pub(super) torque: Words,
    /// Number of cells that contribute to the sum.
    pub(super) count: u8,
}

/// Each cell's last sum for one epoch. The last sum of a cell contains the most cells.
#[derive(Clone, Debug, Default)]
pub(super) struct SumsByCell(BTreeMap<CellId, CellSum>);

impl SumsByCell {
    pub(super) fn insert(&mut self, cell: CellId, sum: CellSum) {
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

    pub(super) fn contains_cell(&self, cell: CellId) -> bool {
        self.0.contains_key(&cell)
    }

    /// Returns each cell with the number of cells that contribute to its sum.
    pub(super) fn contributor_counts(&self) -> impl Iterator<Item = (CellId, u8)> {
        self.0.iter().map(|(cell, sum)| (*cell, sum.count))
    }

    pub(super) fn cells(&self) -> impl Iterator<Item = CellId> {
        self.0.keys().copied()
    }
}

/// Maximum difference in steps between the words of two sums from the same contact state, because rounding carries its
/// remainder into the next sum.
pub(super) const MAX_ROUNDING_STEPS: u32 = 1;

/// The difference in steps that rounding and the tolerance of a comparison allow.
#[derive(Clone, Copy, Debug)]
struct Rounding {
    /// The tolerance in steps of a sum.
    tolerance: u32,
}

impl Rounding {
    fn new(tolerance: u16, format: TorqueFormat) -> Self {
        let finer = 1 << (format.fraction_bits() - TorqueFormat::Q7_8.fraction_bits());
        Self { tolerance: u32::from(tolerance.div_ceil(finer)) }
    }

    /// Returns the allowed difference of a contribution. A cell that only forwards others' sums has no torque that
    /// could differ.
    const fn allowed(self, own: &OwnContribution) -> u32 {
        MAX_ROUNDING_STEPS + if own.cells > 0 { self.tolerance } else { 0 }
    }
}

/// Maximum number of cells that are considered to have changed to or from one parent in an epoch.
const MAX_MOVED_CELLS: usize = 4;

/// A cell's own contribution to its sum.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct OwnContribution {
    /// The sum as it was sent.
    pub sum: Words,
    /// Number of cells that contribute to the sum.
    pub count: u8,
    /// Children whose sums are contained in this sum.
    pub children: Vec<CellId>,
    /// The sum minus the children's sums, in steps of Q7.8; `None` for saturated words.
    pub steps: [Option<i32>; MAX_JOINTS],
    /// The count minus the children's counts: 1 for a cell in contact, 0 for a cell that only forwards its children's
    /// sums.
    pub cells: i32,
}

impl OwnContribution {
    /// Returns the contribution of a cell that sends no sum.
    fn nothing() -> Self {
        Self { sum: Words::default(), count: 0, children: Vec::new(), steps: [Some(0); MAX_JOINTS], cells: 0 }
    }

    /// Returns this contribution with a sum added (`sign` 1) or subtracted (-1).
    fn plus(mut self, sign: i32, sum: &CellSum) -> Self {
        self.cells += sign * i32::from(sum.count);
        for (own, word) in self.steps.iter_mut().zip(sum.torque.padded()) {
            *own = own.zip(value_unless_saturated(word)).map(|(own, word)| own + sign * word);
        }
        self
    }

    /// Returns true if all unsaturated words are zero.
    fn is_zero(&self) -> bool {
        self.steps.iter().flatten().all(|step| *step == 0)
    }

    /// Returns the differences in steps between the words of two contributions, for words that are saturated in
    /// neither.
    pub(super) fn step_differences(&self, other: &Self) -> impl Iterator<Item = u32> {
        let both = self.steps.iter().zip(&other.steps);
        both.filter_map(|(own, it)| Some(own.as_ref()?.abs_diff(*it.as_ref()?)))
    }
}

/// Sums of one epoch and their tree: one side of the comparison, from the recording or from this replay.
pub(super) struct EpochSums<'a> {
    sums: &'a SumsByCell,
    children: BTreeMap<u8, Vec<CellId>>,
    affected: BTreeSet<CellId>,
    /// All remembered parents of each cell that has changed its parent.
    parents: BTreeMap<CellId, BTreeSet<u8>>,
    /// True if the parents of all cells are known.
    is_known: bool,
}

/// Reason why a sum is not compared.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum OmitReason {
    /// The cell, or one of its former or present children, was changing its parent.
    Changing,
    /// The parent of some cell is unknown, because it has not reported it.
    Unknown,
    /// The sum lacks the sum of a child, or contains sums other than those received.
    NotTaken,
}

/// Result of the comparison of a cell's sums.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum SumComparison {
    /// The cell contributed no torque of its own, neither in the recording nor in this replay.
    Nothing,
    Equal,
    Different,
    Missing,
    Extra,
    Omitted(OmitReason),
}

impl<'a> EpochSums<'a> {
    pub(super) fn new(sums: &'a SumsByCell, trees: &ParentHistory, round: u64) -> Self {
        let mut children: BTreeMap<u8, Vec<CellId>> = BTreeMap::new();
        for cell in trees.0.keys() {
            if let Some(parent) = trees.parent_in_round(*cell, round).flatten() {
                children.entry(parent).or_default().push(*cell);
            }
        }
        let is_known = sums.cells().all(|cell| trees.parent_in_round(cell, round).is_some());
        let parents = trees.0.iter().filter(|(_, steps)| steps.len() > 1);
        let parents = parents.map(|(cell, steps)| (*cell, steps.iter().filter_map(|it| it.parent).collect()));
        Self {
            sums,
            children,
            affected: trees.cells_changing_parent(round),
            parents: parents.collect(),
            is_known,
        }
    }

    fn children(&self, cell: CellId) -> &[CellId] {
        self.children.get(&cell.get()).map_or(&[], Vec::as_slice)
    }

    /// Returns a cell's own contribution to its sum, or `None` if the cell sent no sum.
    pub(super) fn own_contribution(&self, cell: CellId) -> Option<OwnContribution> {
        let CellSum { torque: sum, count } = *self.sums.0.get(&cell)?;
        let below = self.children(cell).iter().filter_map(|child| Some((*child, self.sums.0.get(child)?)));
        let (mut children, mut cells) = (Vec::new(), i32::from(count));
        let mut steps = sum.padded().map(value_unless_saturated);
        for (child, its) in below {
            children.push(child);
            cells -= i32::from(its.count);
            for (own, &word) in steps.iter_mut().zip(its.torque.as_slice()) {
                *own = own.zip(value_unless_saturated(word)).map(|(own, word)| own - word);
            }
        }
        Some(OwnContribution { sum, count, children, steps, cells })
    }

    /// Returns true if a cell's sum minus its children's sums cannot be its own contribution, given whether stimuli
    /// touch the cell. Its children were then others than their pages report or, if joints were resent (`is_mixed`),
    /// sums of two sendings are mixed.
    pub(super) fn is_contribution_impossible(
        &self,
        cell: CellId,
        is_touched: Option<bool>,
        is_mixed: bool,
    ) -> bool {
        self.own_contribution(cell).is_some_and(|own| {
            let adds = own.cells == 0 && !own.is_zero();
            is_touched.is_some_and(|is_touched| is_touched != (own.cells > 0)) || is_mixed && adds
        })
    }

    /// Returns true if the cell itself is in contact.
    pub(super) fn is_in_contact(&self, cell: CellId) -> bool {
        self.own_contribution(cell).is_some_and(|own| own.cells > 0)
    }

    /// Returns true if a cell's sum contains the received sums of all its children. The sum minus those sums is then
    /// the cell's own contribution.
    fn contains_child_sums(&self, cell: CellId, other: &Self) -> bool {
        let Some(own) = self.own_contribution(cell) else { return true };
        let adds_up = match own.cells {
            // The sum contains the cell's own contribution but lacks the sum of a child, which counts one cell.
            0 => own.is_zero() || !other.is_in_contact(cell),
            1 => true,
            _ => false,
        };
        // If a child's sum was received on one side only, it is unknown whether this sum contains it.
        let silent = |child: &CellId| !self.sums.contains_cell(*child) && other.is_in_contact(*child);
        adds_up && !self.children(cell).iter().any(silent)
    }

    /// Returns a cell's own contribution on this side and on the other, or `None` if the cell sent no sum on this side.
    /// A cell without a sum on the other side contributes nothing there.
    fn contributions(&self, cell: CellId, other: &Self) -> Option<[OwnContribution; 2]> {
        let own = self.own_contribution(cell)?;
        Some([own, other.own_contribution(cell).unwrap_or_else(OwnContribution::nothing)])
    }

    /// Returns true if a cell's sum differs from that of the other side by the sums of cells that have changed their
    /// parent: it contains those of former or later children, or lacks those of present ones. By its page, such a cell
    /// is still at its former parent in this epoch, because a page follows the change that it reports. An additional
    /// sum must not be contained in another parent's sum.
    fn contains_other_children(&self, cell: CellId, other: &Self, rounding: Rounding) -> bool {
        let Some([own, its]) = self.contributions(cell, other) else { return false };
        let is_elsewhere = |mover: &CellId| {
            let parent = self.children.iter().find(|(_, children)| children.contains(mover));
            let parent = parent.and_then(|(parent, _)| CellId::new(i64::from(*parent)).ok());
            let both = parent.and_then(|parent| self.contributions(parent, other));
            both.is_some_and(|[own, its]| {
                own.cells > its.cells
                    || own.cells == its.cells
                        && own.step_differences(&its).all(|steps| steps <= rounding.allowed(&its))
            })
        };
        let movers = self.parents.iter().filter(|(_, parents)| parents.contains(&cell.get()));
        let movers = movers.filter_map(|(mover, _)| {
            let sum = self.sums.0.get(mover).filter(|sum| sum.count > 0)?;
            let is_child = self.children(cell).contains(mover);
            (is_child || !is_elsewhere(mover)).then_some((if is_child { -1 } else { 1 }, sum))
        });
        let movers: Vec<_> = movers.take(MAX_MOVED_CELLS).collect();
        let allowed = rounding.allowed(&its);
        (1_u32..1 << movers.len()).any(|subset| {
            let chosen = movers.iter().enumerate().filter(|(bit, _)| subset >> bit & 1 == 1);
            let moved =
                chosen.fold(OwnContribution::nothing(), |moved, (_, (sign, sum))| moved.plus(*sign, sum));
            let words = own.steps.iter().zip(&its.steps).zip(&moved.steps);
            // A word that is known on both sides must be known of the moved cells, too.
            let mut compared = words.filter_map(|((own, its), moved)| {
                let steps = own.as_ref()? - its.as_ref()?;
                Some(moved.map(|moved| (steps - moved).unsigned_abs()))
            });
            // Small sums would explain differences between contributions of equally many cells by rounding.
            let explains =
                moved.cells != 0 || moved.steps.iter().flatten().any(|step| step.unsigned_abs() > allowed);
            explains
                && own.cells - its.cells == moved.cells
                && compared.all(|left| left.is_some_and(|left| left <= allowed))
        })
    }

    /// Returns the cells below a cell in the tree.
    fn subtree(&self, cell: CellId) -> BTreeSet<CellId> {
        let (mut all, mut next) = (BTreeSet::new(), vec![cell]);
        while let Some(cell) = next.pop() {
            if self.sums.contains_cell(cell) && all.insert(cell) {
                next.extend(self.children(cell));
            }
        }
        all
    }
}

fn value_unless_saturated(word: i16) -> Option<i32> {
    (!Q7_8::from_bits(word).is_saturated()).then(|| i32::from(word))
}

/// Compares a cell's own contribution in the recording with that in this replay. A torque may differ by `tolerance` of
/// its own steps, which may move the rounded sum across one more bound. The children's differences cancel, so the
/// tolerance does not depend on the number of cells in the sum.
pub(super) fn compare(
    recorded: &EpochSums<'_>,
    now: &EpochSums<'_>,
    cell: CellId,
    tolerance: u16,
    format: TorqueFormat,
) -> SumComparison {
    if recorded.affected.contains(&cell) || now.affected.contains(&cell) {
        return SumComparison::Omitted(OmitReason::Changing);
    }
    if !recorded.is_known || !now.is_known {
        return SumComparison::Omitted(OmitReason::Unknown);
    }
    if !recorded.contains_child_sums(cell, now) || !now.contains_child_sums(cell, recorded) {
        return SumComparison::Omitted(OmitReason::NotTaken);
    }
    let (then, today) = (recorded.own_contribution(cell), now.own_contribution(cell));
    let rounding = Rounding::new(tolerance, format);
    match (&then, &today) {
        (Some(then), Some(today)) => {
            let allowed = rounding.allowed(then);
            // A word can be saturated by the sum over a whole subtree, so in another tree other cells have saturated
            // words.
            let alike = |then: i16, today: i16| {
                value_unless_saturated(then).is_none() == value_unless_saturated(today).is_none()
                    || recorded.subtree(cell) != now.subtree(cell)
            };
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
                return SumComparison::Equal;
            }
        }
        (Some(then), None) if then.cells > 0 => return SumComparison::Missing,
        (None, Some(today)) if today.cells > 0 => return SumComparison::Extra,
        // The tree decides whether a cell forwards sums of others, but forwarding adds no torque.
        (Some(own), None) | (None, Some(own)) if !own.is_zero() => {}
        (Some(_), None) | (None, Some(_) | None) => return SumComparison::Nothing,
    }
    let moved = now.contains_other_children(cell, recorded, rounding)
        || recorded.contains_other_children(cell, now, rounding);
    if moved { SumComparison::Omitted(OmitReason::NotTaken) } else { SumComparison::Different }
}

#[cfg(test)]
mod tests;
