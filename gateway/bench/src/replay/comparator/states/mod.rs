//! State machines of the comparison: named states, inputs, and a table of both.
//!
//! | subject | machine | states | decides |
//! |---|---|---|---|
//! | a bus | [`line`] | `Up`, `Down` | whether its cells are awaited |
//! | a cell on it now | [`progress`] | `Done`, `Awaited`, `GivenUp` | whether the next joints wait for it |
//! | a pass over the capture | [`pass`] | `Fresh`, `Before`, `Whole`, `Part` | whether a reply may answer joints that are not resent |
//! | a round of joints | [`sending`] | `Recorded`, `Sent`, `Repeated`, `Unsent`, `RepeatedUnsent` | whether and how it is compared |
//! | a cell of the capture | [`contact`] | `Unknown`, `Lasts`, `Over`; `AsRecorded`, `Earlier` | whether the end of a contact may be missing |
//! | a cell, then and now | [`first_joints`] | `Taken`, `Awaited` | whether its sensor values belong to joints |
//!
//! The tests of each module hold its table as a list of rows, and go through all states and inputs.

pub(super) mod contact;
pub(super) mod first_joints;
pub(super) mod line;
pub(super) mod pass;
pub(super) mod progress;
pub(super) mod sending;

/// A row of a table: its name, its states and inputs, and the function from such a state to the next.
#[cfg(test)]
type Row<'a, S, I, O> = (&'a str, &'a [S], &'a [I], fn(S) -> O);

/// Checks that each state has exactly one row for each input, and that the machine follows the row.
#[cfg(test)]
fn check_table<S, I, O>((states, inputs): (&[S], &[I]), rows: &[Row<'_, S, I, O>], next: impl Fn(S, I) -> O)
where
    S: Copy + core::fmt::Debug + PartialEq,
    I: Copy + core::fmt::Debug + PartialEq,
    O: core::fmt::Debug + PartialEq,
{
    for &state in states {
        for &input in inputs {
            let is_of = |row: &&Row<'_, S, I, O>| row.1.contains(&state) && row.2.contains(&input);
            let found: Vec<_> = rows.iter().filter(is_of).collect();
            assert_eq!(found.len(), 1, "rows of {state:?} and {input:?}");
            let (name, _, _, expected) = found[0];
            assert_eq!(next(state, input), expected(state), "{name}: {state:?} and {input:?}");
        }
    }
    for (name, of, shows, _) in rows {
        let is_known =
            of.iter().all(|state| states.contains(state)) && shows.iter().all(|it| inputs.contains(it));
        assert!(is_known, "{name} has a state or an input that is not in the lists");
    }
}
