//! The number of cells that fit on a bus, the number of buses that cells need, and the deciding limit.

use serde::Serialize;

use super::case::BusCase;

/// The approximate number of nodes that common transceivers can drive on one bus, including the gateway.
pub const MAX_NODES_PER_BUS: u32 = 110;

/// Upper end of the search for the maximum number of cells.
const MAX_SEARCHED_CELLS: u32 = 1 << 20;

/// A limit on the number of cells on a bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Limit {
    /// All frames together take longer than the time of the bus.
    Bandwidth,
    /// The last answer may end after its deadline, the next joints; for sums, after 7/8 of the period.
    Deadline,
    /// The bus has more nodes than transceivers can drive.
    Nodes,
}

impl Limit {
    /// Returns the name of the limit in texts.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bandwidth => "bandwidth",
            Self::Deadline => "deadline",
            Self::Nodes => "nodes",
        }
    }
}

/// One value for each limit.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub struct ByLimit<T> {
    /// Bandwidth: the load, including heartbeats, is at most 100 %.
    pub bandwidth: T,
    /// Deadline: the last answer always ends in time.
    pub deadline: T,
    /// Number of nodes that transceivers can drive.
    pub nodes: T,
}

impl<T> ByLimit<T> {
    /// Returns the limits whose value satisfies a condition, in this order.
    fn limits_where(self, holds: impl Fn(T) -> bool) -> Vec<Limit> {
        let Self { bandwidth, deadline, nodes } = self;
        let all = [(Limit::Bandwidth, bandwidth), (Limit::Deadline, deadline), (Limit::Nodes, nodes)];
        all.into_iter().filter_map(|(limit, it)| holds(it).then_some(limit)).collect()
    }
}

impl ByLimit<bool> {
    /// Returns the limits whose value is false: the bus does not keep them.
    #[must_use]
    pub fn exceeded(self) -> Vec<Limit> {
        self.limits_where(|holds| !holds)
    }
}

/// The maximum number of cells on one bus by each limit; for nodes, [`MAX_NODES_PER_BUS`] minus the gateway.
pub type MaxCells = ByLimit<u32>;

impl MaxCells {
    /// Computes the maximum number of cells by each limit, for a bus like this one.
    #[must_use]
    pub fn for_case(case: &BusCase) -> Self {
        Self {
            bandwidth: largest_count_where(|cells| is_load_within_limit(&case.with_cells(cells))),
            deadline: largest_count_where(|cells| case.with_cells(cells).is_in_time()),
            nodes: MAX_NODES_PER_BUS - 1,
        }
    }

    /// Returns the maximum number of cells for which the bus is fast enough: the smaller of bandwidth and deadline.
    #[must_use]
    pub fn max_cells_in_time(&self) -> u32 {
        self.bandwidth.min(self.deadline)
    }
}

/// Returns true if the load is at most 100 %.
fn is_load_within_limit(case: &BusCase) -> bool {
    case.load().total() <= 1.0
}

/// Returns the limits that a bus exceeds.
#[must_use]
pub fn exceeded_limits(case: &BusCase) -> Vec<Limit> {
    let holds = ByLimit {
        bandwidth: is_load_within_limit(case),
        deadline: case.is_in_time(),
        nodes: case.answers.cells() < MAX_NODES_PER_BUS,
    };
    holds.exceeded()
}

/// Returns the largest number of cells up to which a condition holds; 0 if it does not hold for 1.
fn largest_count_where(holds: impl Fn(u32) -> bool) -> u32 {
    let mut beyond = 1;
    while beyond < MAX_SEARCHED_CELLS && holds(beyond) {
        beyond *= 2;
    }
    let mut min = beyond / 2;
    while beyond - min > 1 {
        let middle = min.midpoint(beyond);
        if holds(middle) {
            min = middle;
        } else {
            beyond = middle;
        }
    }
    min
}

/// The number of buses that cells need, by each limit; `None` if not even one cell fits.
pub type NeededBuses = ByLimit<Option<u32>>;

impl NeededBuses {
    /// Computes the number of buses by each limit, for cells that are spread evenly.
    #[must_use]
    pub fn for_cells(most: &MaxCells, cells: u32) -> Self {
        let buses = |most: u32| (most > 0).then(|| cells.div_ceil(most));
        Self { bandwidth: buses(most.bandwidth), deadline: buses(most.deadline), nodes: buses(most.nodes) }
    }

    /// Adds up the numbers of buses of two chains, which cannot share a bus.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        let sum = |one: Option<u32>, other: Option<u32>| Some(one? + other?);
        let mut both = Self {
            bandwidth: sum(self.bandwidth, other.bandwidth),
            deadline: sum(self.deadline, other.deadline),
            nodes: sum(self.nodes, other.nodes),
        };
        // The two chains may be bound by different limits.
        let buses = sum(self.required_buses(), other.required_buses());
        for limit in both.binding_limits() {
            *match limit {
                Limit::Bandwidth => &mut both.bandwidth,
                Limit::Deadline => &mut both.deadline,
                Limit::Nodes => &mut both.nodes,
            } = buses;
        }
        both
    }

    /// Returns the number of buses that bandwidth and deadline require; `None` if not even one cell is in time.
    #[must_use]
    pub fn buses_for_timing(&self) -> Option<u32> {
        Some(self.bandwidth?.max(self.deadline?))
    }

    /// Returns the number of buses that all limits together require.
    #[must_use]
    pub fn required_buses(&self) -> Option<u32> {
        Some(self.buses_for_timing()?.max(self.nodes?))
    }

    /// Returns the limits that require the largest number of buses.
    #[must_use]
    pub fn binding_limits(&self) -> Vec<Limit> {
        // `None` counts as more than any number.
        let key = |buses: Option<u32>| buses.unwrap_or(u32::MAX);
        let most = [self.bandwidth, self.deadline, self.nodes].map(key).into_iter().max();
        self.limits_where(|buses| Some(key(buses)) == most)
    }

    /// Returns the number of buses and the limits that require it, as a short text such as `3 (nodes)`. Bandwidth and
    /// deadline are both called time.
    #[must_use]
    pub fn short_text(&self) -> String {
        let word = |limit| match limit {
            Limit::Bandwidth | Limit::Deadline => "time",
            Limit::Nodes => "nodes",
        };
        let mut words: Vec<_> = self.binding_limits().into_iter().map(word).collect();
        words.dedup();
        match self.required_buses() {
            Some(1) => "1".to_owned(),
            Some(buses) => format!("{buses} ({})", words.join(", ")),
            None => format!("none ({})", words.join(", ")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_max_is_found_wherever_it_is() {
        for limit in [0, 1, 2, 3, 4, 5, 63, 64, 65, 253, 1_000] {
            assert_eq!(largest_count_where(|number| number <= limit), limit);
        }
        assert!(largest_count_where(|_| true) >= MAX_SEARCHED_CELLS / 2);
    }
    #[test]
    fn the_larger_need_binds_and_equal_ones_both() {
        let need =
            |bandwidth, deadline| NeededBuses::for_cells(&MaxCells { bandwidth, deadline, nodes: 109 }, 253);
        assert_eq!(
            (need(212, 223).required_buses(), need(212, 223).binding_limits()),
            (Some(3), vec![Limit::Nodes])
        );
        assert_eq!(need(212, 223).buses_for_timing(), Some(2));
        assert_eq!(
            (need(58, 57).required_buses(), need(58, 57).binding_limits()),
            (Some(5), vec![Limit::Bandwidth, Limit::Deadline])
        );
        assert_eq!((need(2, 0).required_buses(), need(2, 0).binding_limits()), (None, vec![Limit::Deadline]));
        assert_eq!(need(90, 91).binding_limits(), Limit::all());
    }

    impl Limit {
        fn all() -> Vec<Self> {
            vec![Self::Bandwidth, Self::Deadline, Self::Nodes]
        }
    }
}
