use super::*;
use proptest::prelude::*;

fn cell(node: u8) -> CellId {
    CellId::new(node.into()).unwrap()
}

/// Contribution of each cell in steps; cells are numbered from 1.
type Contact = Vec<Option<[i16; 6]>>;

/// Builds the sums of a tree, given the parent of each cell, 0 for the gateway's side. Parents precede their children.
fn sums(contact: &Contact, parents: &[u8]) -> (SumsByCell, ParentHistory) {
    let (mut sums, mut trees) = (SumsByCell::default(), ParentHistory::default());
    let mut totals = vec![([0_i32; 6], 0_u8); contact.len()];
    for place in (0..contact.len()).rev() {
        if let Some(own) = contact[place] {
            totals[place].1 += 1;
            (0..6).for_each(|word| totals[place].0[word] += i32::from(own[word]));
        }
        let (total, count) = totals[place];
        if let Some(above) = parents[place].checked_sub(1).map(usize::from) {
            totals[above].1 += count;
            (0..6).for_each(|word| totals[above].0[word] += total[word]);
        }
        let id = cell(u8::try_from(place + 1).unwrap());
        trees.set_parent(id, Some(parents[place]), 0);
        if count > 0 {
            let torque = total.map(|word| i16::try_from(word).unwrap()).into();
            sums.insert(id, CellSum { torque, count });
        }
    }
    (sums, trees)
}

fn outcomes(
    then: &(SumsByCell, ParentHistory),
    today: &(SumsByCell, ParentHistory),
    cells: usize,
) -> Vec<SumComparison> {
    outcomes_within(0, then, today, cells)
}

fn outcomes_within(
    tolerance: u16,
    then: &(SumsByCell, ParentHistory),
    today: &(SumsByCell, ParentHistory),
    cells: usize,
) -> Vec<SumComparison> {
    let (then, today) = (EpochSums::new(&then.0, &then.1, 5), EpochSums::new(&today.0, &today.1, 5));
    (1..=u8::try_from(cells).unwrap())
        .map(|node| compare(&then, &today, cell(node), tolerance, TorqueFormat::Q3_12))
        .collect()
}

fn words(first: i16) -> Option<[i16; 6]> {
    Some([first, 0, -3, 0, 0, 0])
}

#[test]
fn the_same_contributions_are_equal_in_any_tree() {
    // Trees 1 - 2 - 3 and 1 - (2, 3); in the first, cell 2 only forwards.
    let contact = vec![words(10), None, words(30)];
    let both = (sums(&contact, &[0, 1, 2]), sums(&contact, &[0, 1, 1]));
    assert_eq!(
        outcomes(&both.0, &both.1, 3),
        [SumComparison::Equal, SumComparison::Nothing, SumComparison::Equal]
    );
    let side = EpochSums::new(&both.0.0, &both.0.1, 5);
    let own = side.own_contribution(cell(1)).unwrap();
    assert_eq!((own.steps[0], own.cells, own.children), (Some(10), 1, vec![cell(2)]));
    assert_eq!((own.sum.as_slice()[0], own.count), (40, 2));
}

#[test]
fn one_step_is_rounding_and_two_are_a_difference() {
    let then = sums(&vec![words(10), words(20)], &[0, 1]);
    let today = sums(&vec![words(10), words(21)], &[0, 1]);
    assert_eq!(outcomes(&then, &today, 2), [SumComparison::Equal; 2]);
    let today = sums(&vec![words(10), words(22)], &[0, 1]);
    assert_eq!(outcomes(&then, &today, 2), [SumComparison::Equal, SumComparison::Different]);
}

#[test]
fn a_cell_without_contact_now_is_missing_and_one_without_contact_then_is_extra() {
    let then = sums(&vec![words(10), words(20), None], &[0, 0, 0]);
    let today = sums(&vec![words(10), None, words(1)], &[0, 0, 0]);
    assert_eq!(
        outcomes(&then, &today, 3),
        [SumComparison::Equal, SumComparison::Missing, SumComparison::Extra]
    );
    // A cell that only forwards still sends a sum; its own count shows it.
    let then = sums(&vec![words(10), words(20)], &[0, 1]);
    let today = sums(&vec![None, words(20)], &[0, 1]);
    assert_eq!(outcomes(&then, &today, 2), [SumComparison::Different, SumComparison::Equal]);
}

#[test]
fn a_forwarding_cell_must_not_add_anything() {
    let contact = vec![None, words(20)];
    let (then, other) = (sums(&contact, &[0, 1]), sums(&contact, &[0, 0]));
    let mut today = sums(&contact, &[0, 1]);
    let sum = today.0.0.get_mut(&cell(1)).unwrap();
    let [a, b, _, d, e, f] = sum.torque.first_six();
    sum.torque = [a, b, 9, d, e, f].into();
    assert_eq!(outcomes(&then, &today, 2), [SumComparison::Different, SumComparison::Equal]);
    assert_eq!(outcomes(&other, &today, 2), [SumComparison::Different, SumComparison::Equal]);
    assert_eq!(outcomes(&today, &other, 2), [SumComparison::Different, SumComparison::Equal]);
}

#[test]
fn a_cell_with_uncertain_children_is_omitted() {
    let contact = vec![words(10), words(20), words(30), words(40)];
    let then = sums(&contact, &[0, 0, 1, 0]);
    let mut today = sums(&contact, &[0, 0, 1, 0]);
    today.1.set_parent(cell(3), None, 6);
    today.1.set_parent(cell(3), Some(2), 6);
    let changing = SumComparison::Omitted(OmitReason::Changing);
    assert_eq!(outcomes(&then, &today, 4), [changing, changing, changing, SumComparison::Equal]);
    // The third cell's parent is unknown.
    today.1.0.remove(&cell(3));
    assert_eq!(outcomes(&then, &today, 4), [SumComparison::Omitted(OmitReason::Unknown); 4]);
}

#[test]
fn a_child_with_a_late_page_is_no_difference_unless_it_is_counted_twice() {
    // By its page the third cell's parent is the second; its sums go to the first.
    let contact = vec![None, words(20), words(30), None];
    let then = sums(&contact, &[0, 1, 1, 0]);
    let mut today = sums(&contact, &[0, 1, 1, 0]);
    today.1.0.remove(&cell(3));
    let omitted = SumComparison::Omitted(OmitReason::NotTaken);
    for (parents, counted_twice, expected) in [
        (&[2, 1][..], false, omitted),
        (&[2], false, SumComparison::Different),
        (&[2, 4], false, SumComparison::Different),
        (&[2, 1], true, SumComparison::Different),
    ] {
        let mut today = (SumsByCell(today.0.0.clone()), ParentHistory::default());
        for node in 1..=4 {
            today.1.set_parent(cell(node), Some([0, 1, 2, 0][usize::from(node) - 1]), 0);
        }
        for (parent, since) in parents.iter().zip([0, 9]) {
            today.1.set_parent(cell(3), Some(*parent), since);
        }
        if counted_twice {
            for (node, count) in [(1, 3), (2, 2)] {
                let sum = today.0.0.get_mut(&cell(node)).unwrap();
                sum.count = count;
                let torque: [i16; 6] = std::array::from_fn(|word| {
                    let [second, third] = [1, 2].map(|at: usize| contact[at].unwrap()[word]);
                    second + third * (i16::from(count) - 1)
                });
                sum.torque = torque.into();
            }
        }
        for tolerance in [0, 16] {
            let outcome = outcomes_within(tolerance, &then, &today, 1)[0];
            assert_eq!(outcome, expected, "{parents:?}, {counted_twice}, {tolerance}");
        }
    }
}

#[test]
fn children_that_change_places_with_late_pages_are_no_difference() {
    // Cells 2 and 3 have changed places: by their pages they are at cells 1 and 4, which forward the other's sum.
    let contact = vec![None, words(20), words(30), None];
    let mut recorded = sums(&contact, &[0, 4, 1, 0]);
    recorded.1 = ParentHistory::default();
    for (node, parent, later) in [(1, 0, 0), (2, 1, 4), (3, 4, 1), (4, 0, 0)] {
        recorded.1.set_parent(cell(node), Some(parent), 0);
        recorded.1.set_parent(cell(node), Some(later), 9);
    }
    for (node, torque) in [(1, 30), (4, 20)] {
        let torque = words(torque).unwrap().into();
        recorded.0.0.insert(cell(node), CellSum { torque, count: 1 });
    }
    let [omitted, equal] = [SumComparison::Omitted(OmitReason::NotTaken), SumComparison::Equal];
    // In the other tree the forwarding cells forward as the pages have it, or nothing.
    for parents in [[0, 1, 0, 0], [0, 0, 0, 0]] {
        let mut today = sums(&contact, &parents);
        if parents[1] == 1 {
            today.1 = ParentHistory::default();
            for (node, parent) in [(1, 0), (2, 1), (3, 4), (4, 0)] {
                today.1.set_parent(cell(node), Some(parent), 0);
            }
            today.0.0.insert(cell(4), CellSum { torque: words(30).unwrap().into(), count: 1 });
        }
        assert_eq!(outcomes(&recorded, &today, 4), [omitted, equal, equal, omitted]);
        assert_eq!(outcomes(&today, &recorded, 4), [omitted, equal, equal, omitted]);
    }
    // A cell whose touch is missing stays missing, although a former child has the same words.
    let quiet = sums(&vec![None, words(20), None, None], &[0, 0, 0, 0]);
    let mut touched = sums(&vec![words(20), words(20), None, None], &[0, 0, 0, 0]);
    touched.1.set_parent(cell(2), Some(1), 9);
    assert_eq!(outcomes(&touched, &quiet, 1), [SumComparison::Missing]);
    assert_eq!(outcomes(&quiet, &touched, 1), [SumComparison::Extra]);
    // A wrong word is still a difference.
    let sum = recorded.0.0.get_mut(&cell(1)).unwrap();
    sum.torque = [30, 5, -3, 0, 0, 0].into();
    let today = sums(&contact, &[0, 0, 0, 0]);
    assert_eq!(outcomes(&recorded, &today, 4)[0], SumComparison::Different);
}

#[test]
fn a_cell_between_two_parents_is_omitted_and_an_unreachable_one_is_not() {
    let contact = vec![words(10), words(20)];
    let then = sums(&contact, &[0, 1]);
    let mut today = sums(&vec![words(10), None], &[0, 1]);
    today.1.set_parent(cell(2), None, 2);
    assert_eq!(outcomes(&then, &today, 2), [SumComparison::Equal, SumComparison::Missing]);
    today.1.set_parent(cell(2), Some(0), 9);
    assert_eq!(
        outcomes(&then, &today, 2),
        [SumComparison::Equal, SumComparison::Omitted(OmitReason::Changing)]
    );
}

#[test]
fn a_sum_that_lacks_a_childs_is_omitted() {
    let contact = vec![words(10), words(20), None];
    let then = sums(&contact, &[0, 1, 0]);
    let mut today = sums(&contact, &[0, 1, 0]);
    let alone = CellSum { torque: words(10).unwrap().into(), count: 1 };
    today.0.0.insert(cell(1), alone);
    let torn = SumComparison::Omitted(OmitReason::NotTaken);
    assert_eq!(outcomes(&then, &today, 2), [torn, SumComparison::Equal]);
    // The child's sum was lost on the way to the recording, but is in the parent's.
    let mut then = sums(&vec![None, words(20)], &[0, 1]);
    let today = sums(&vec![None, words(20)], &[0, 1]);
    then.0.0.remove(&cell(2));
    assert_eq!(outcomes(&then, &today, 2), [torn, SumComparison::Extra]);
}

#[test]
fn of_two_sums_the_one_with_more_cells_counts() {
    let mut sums = SumsByCell::default();
    let sum = |word, count| CellSum { torque: [word; 6].into(), count };
    for next in [sum(1, 1), sum(5, 3), sum(4, 2), sum(6, 3)] {
        sums.insert(cell(1), next);
    }
    assert_eq!(sums.0[&cell(1)], sum(5, 3));
}

#[test]
fn saturated_words_are_compared_as_saturated() {
    let then = sums(&vec![words(10), words(20)], &[0, 1]);
    let saturate = |mut side: (SumsByCell, ParentHistory), node| {
        let sum = side.0.0.get_mut(&cell(node)).unwrap();
        let [_, b, c, d, e, f] = sum.torque.first_six();
        sum.torque = [i16::MAX, b, c, d, e, f].into();
        side
    };
    let whole = |contact: &Contact, parents: &[u8]| saturate(sums(contact, parents), 1);
    let contact = vec![words(10), words(20)];
    assert_eq!(outcomes(&whole(&contact, &[0, 1]), &whole(&contact, &[0, 1]), 2), [SumComparison::Equal; 2]);
    assert_eq!(
        outcomes(&then, &whole(&contact, &[0, 1]), 2),
        [SumComparison::Different, SumComparison::Equal],
        "the same cells are in it"
    );
    let other = sums(&contact, &[0, 0]);
    assert_eq!(outcomes(&other, &whole(&contact, &[0, 1]), 2)[0], SumComparison::Equal, "others are in it");
    // The other words are compared as usual.
    let contact = vec![Some([10, 9, 0, 0, 0, 0]), words(20)];
    assert_eq!(outcomes(&whole(&contact, &[0, 1]), &then, 2)[0], SumComparison::Different);
}

#[test]
fn trees_drop_past_rounds() {
    let mut trees = ParentHistory::default();
    for round in 0..1_000_u64 {
        trees.set_parent(cell(1), Some((round % 2).to_le_bytes()[0]), round);
        trees.forget_changes_before(round.saturating_sub(100));
        assert!(trees.0[&cell(1)].len() <= 104);
        assert_eq!(trees.parent_in_round(cell(1), round), Some(Some((round % 2).to_le_bytes()[0])));
    }
}

proptest! {
    /// Compares any two trees over cells with the same contributions: there is no difference. If one cell contributes
    /// another value, only that cell differs.
    #[test]
    fn the_tree_leaves_no_trace(
        contact in proptest::collection::vec(proptest::option::of([-60_i16..=60, -60..=60, -60..=60, -60..=60, -60..=60, -60..=60]), 1..40),
        trees: [[u8; 40]; 2],
        odd: (u8, i16),
    ) {
        let parents = |seeds: &[u8; 40]| -> Vec<u8> {
            (0..contact.len()).map(|place| seeds[place] % u8::try_from(place + 1).unwrap()).collect()
        };
        let [then, today] = [parents(&trees[0]), parents(&trees[1])];
        let recorded = sums(&contact, &then);
        let all = outcomes(&recorded, &sums(&contact, &today), contact.len());
        for (place, outcome) in all.iter().enumerate() {
            let target = if contact[place].is_some() {
                matches!(outcome, SumComparison::Equal)
            } else {
                matches!(outcome, SumComparison::Nothing | SumComparison::Equal)
            };
            prop_assert!(target, "cell {}: {outcome:?}", place + 1);
        }
        let at = usize::from(odd.0) % contact.len();
        let mut other = contact.clone();
        if let (Some(words), true) = (&mut other[at], odd.1.unsigned_abs() > 1) {
            words[3] = words[3].wrapping_add(odd.1 % 60 + 2 * odd.1.signum());
            let again = outcomes(&recorded, &sums(&other, &today), contact.len());
            for (place, outcome) in again.iter().enumerate() {
                prop_assert_eq!(*outcome == SumComparison::Different, place == at, "cell {}", place + 1);
            }
        }
    }
}
