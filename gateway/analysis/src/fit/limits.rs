//! How many cells fit on a bus, how many buses cells need, and which limit decides.

use serde::Serialize;

use super::case::Case;

/// About as many nodes as common transceivers drive on one bus; the gateway is one of them.
pub const NODES: u32 = 110;

/// The most cells that are looked at on one bus.
const ENDLESS: u32 = 1 << 20;

/// What keeps more cells from a bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Limit {
    /// All frames together take longer than there is time.
    Bandwidth,
    /// The last answer comes after the next joints.
    Deadline,
    /// Transceivers do not drive more.
    Nodes,
}

impl Limit {
    /// Its name in texts.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bandwidth => "bandwidth",
            Self::Deadline => "deadline",
            Self::Nodes => "nodes",
        }
    }
}

/// Something for each limit.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub struct ByLimit<T> {
    /// For bandwidth: with heartbeats and everything, at most 100 % load.
    pub bandwidth: T,
    /// For the deadline: so that the last answer is there in time.
    pub deadline: T,
    /// For the number of nodes, electrically.
    pub nodes: T,
}

impl<T> ByLimit<T> {
    /// The limits of which something holds, in this order.
    fn which(self, holds: impl Fn(T) -> bool) -> Vec<Limit> {
        let Self { bandwidth, deadline, nodes } = self;
        let all = [(Limit::Bandwidth, bandwidth), (Limit::Deadline, deadline), (Limit::Nodes, nodes)];
        all.into_iter().filter_map(|(limit, it)| holds(it).then_some(limit)).collect()
    }
}

impl ByLimit<bool> {
    /// The limits that do not hold.
    #[must_use]
    pub fn broken(self) -> Vec<Limit> {
        self.which(|holds| !holds)
    }
}

/// The most cells that each limit lets onto one bus; of nodes [`NODES`] less the gateway.
pub type Most = ByLimit<u32>;

impl Most {
    /// Of a bus like this one.
    #[must_use]
    pub fn of(case: &Case) -> Self {
        Self {
            bandwidth: max(|cells| has_room(&case.with_cells(cells))),
            deadline: max(|cells| case.with_cells(cells).is_in_time()),
            nodes: NODES - 1,
        }
    }

    /// In time: by the tighter of bandwidth and deadline.
    #[must_use]
    pub fn in_time(&self) -> u32 {
        self.bandwidth.min(self.deadline)
    }
}

/// Whether all frames find their time.
fn has_room(case: &Case) -> bool {
    case.load().total() <= 1.0
}

/// What is too much on a bus.
#[must_use]
pub fn exceeded(case: &Case) -> Vec<Limit> {
    let holds = ByLimit {
        bandwidth: has_room(case),
        deadline: case.is_in_time(),
        nodes: case.answers.cells() < NODES,
    };
    holds.broken()
}

/// The largest number up to which a condition holds; 0 when it does not hold for 1.
fn max(holds: impl Fn(u32) -> bool) -> u32 {
    let mut beyond = 1;
    while beyond < ENDLESS && holds(beyond) {
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

/// Buses that so many cells take, by each limit; `None` where not even one cell fits.
pub type Need = ByLimit<Option<u32>>;

impl Need {
    /// Of so many cells, spread evenly.
    #[must_use]
    pub fn of(most: &Most, cells: u32) -> Self {
        let buses = |most: u32| (most > 0).then(|| cells.div_ceil(most));
        Self { bandwidth: buses(most.bandwidth), deadline: buses(most.deadline), nodes: buses(most.nodes) }
    }

    /// Those of two chains, which share no bus.
    #[must_use]
    pub fn with(self, other: Self) -> Self {
        let sum = |one: Option<u32>, other: Option<u32>| Some(one? + other?);
        let mut both = Self {
            bandwidth: sum(self.bandwidth, other.bandwidth),
            deadline: sum(self.deadline, other.deadline),
            nodes: sum(self.nodes, other.nodes),
        };
        // Each chain may be bound by another limit.
        let buses = sum(self.buses(), other.buses());
        for limit in both.binding() {
            *match limit {
                Limit::Bandwidth => &mut both.bandwidth,
                Limit::Deadline => &mut both.deadline,
                Limit::Nodes => &mut both.nodes,
            } = buses;
        }
        both
    }

    /// In time, whatever the transceivers.
    #[must_use]
    pub fn in_time(&self) -> Option<u32> {
        Some(self.bandwidth?.max(self.deadline?))
    }

    /// By all limits.
    #[must_use]
    pub fn buses(&self) -> Option<u32> {
        Some(self.in_time()?.max(self.nodes?))
    }

    /// The limits that require that many.
    #[must_use]
    pub fn binding(&self) -> Vec<Limit> {
        // None is more than any number.
        let key = |buses: Option<u32>| buses.unwrap_or(u32::MAX);
        let most = [self.bandwidth, self.deadline, self.nodes].map(key).into_iter().max();
        self.which(|buses| Some(key(buses)) == most)
    }

    /// How many buses, and which limits require them, in few words: `3 nodes`. Bandwidth and deadline are both a matter of time.
    #[must_use]
    pub fn in_short(&self) -> String {
        let word = |limit| match limit {
            Limit::Bandwidth | Limit::Deadline => "time",
            Limit::Nodes => "nodes",
        };
        let mut words: Vec<_> = self.binding().into_iter().map(word).collect();
        words.dedup();
        match self.buses() {
            Some(1) => "1".to_owned(),
            Some(buses) => format!("{buses} {}", words.join(", ")),
            None => format!("none {}", words.join(", ")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_max_is_found_wherever_it_is() {
        for limit in [0, 1, 2, 3, 4, 5, 63, 64, 65, 253, 1_000] {
            assert_eq!(max(|number| number <= limit), limit);
        }
        assert!(max(|_| true) >= ENDLESS / 2);
    }
    #[test]
    fn the_larger_need_binds_and_equal_ones_both() {
        let need = |bandwidth, deadline| Need::of(&Most { bandwidth, deadline, nodes: 109 }, 253);
        assert_eq!((need(212, 223).buses(), need(212, 223).binding()), (Some(3), vec![Limit::Nodes]));
        assert_eq!(need(212, 223).in_time(), Some(2));
        assert_eq!(
            (need(58, 57).buses(), need(58, 57).binding()),
            (Some(5), vec![Limit::Bandwidth, Limit::Deadline])
        );
        assert_eq!((need(2, 0).buses(), need(2, 0).binding()), (None, vec![Limit::Deadline]));
        assert_eq!(need(90, 91).binding(), Limit::all());
    }

    impl Limit {
        fn all() -> Vec<Self> {
            vec![Self::Bandwidth, Self::Deadline, Self::Nodes]
        }
    }
}
