//! The summary that a run writes as JSON.

use serde_json::Value;

/// The summary of a run.
#[derive(Debug)]
pub struct Summary(pub Value);

impl Summary {
    /// Returns a number of the first bus by its pointer, such as `/replies/due`.
    pub fn of_bus(&self, pointer: &str) -> u64 {
        self.number(&format!("/buses/0{pointer}"))
    }

    /// Returns a whole number by its JSON pointer.
    pub fn number(&self, pointer: &str) -> u64 {
        self.0.pointer(pointer).and_then(Value::as_u64).unwrap_or_else(|| panic!("{pointer} in {:#}", self.0))
    }

    /// Returns a number of a table, or 0 if the key is left out.
    pub fn count(&self, table: &str, key: &str) -> u64 {
        self.0.pointer(table).unwrap()[key].as_u64().unwrap_or(0)
    }

    /// Returns a number with a fraction by its JSON pointer.
    pub fn figure(&self, pointer: &str) -> f64 {
        self.0.pointer(pointer).and_then(Value::as_f64).unwrap_or_else(|| panic!("{pointer} in {:#}", self.0))
    }

    /// Returns the sum of a table of counts.
    pub fn total(&self, table: &str) -> u64 {
        self.0.pointer(table).unwrap().as_object().unwrap().values().map(|it| it.as_u64().unwrap()).sum()
    }

    /// Returns the number of irregular events on a bus, without late torques, which depend on the machine.
    pub fn odd(&self, bus: usize) -> u64 {
        let table = format!("/buses/{bus}/events");
        self.total(&table) - self.count(&table, "stale torque")
    }

    /// Checks that this number of cells had to answer every broadcast, unless on a busy machine some counted as dead.
    pub fn all_were_due(&self, cells: u64, stderr: &str) {
        let (due, all) = (self.of_bus("/replies/due"), cells * self.number("/loop/broadcasts"));
        let away = stderr.contains("fallen silent");
        assert!(due == all || (away && due < all && due > 0), "{due} of {all} due: {:#}", self.0);
    }

    /// Returns the cells of the first bus that were silent at the end.
    pub fn silent(&self) -> Vec<u64> {
        let cells = self.0["buses"][0]["silent_cells"].as_array().unwrap();
        cells.iter().map(|cell| cell.as_u64().unwrap()).collect()
    }

    /// Returns the table of each cell.
    pub fn cells(&self) -> &[Value] {
        self.0["cells"].as_array().unwrap()
    }

    /// Checks that the counts of replies, packets and frames add up on every bus.
    pub fn adds_up(&self) -> &Self {
        let buses = self.0["buses"].as_array().unwrap().len();
        for bus in 0..buses {
            let of = |pointer: &str| self.number(&format!("/buses/{bus}{pointer}"));
            let reasons = [
                "in_time",
                "late",
                "too_late",
                "skipped",
                "not_heard",
                "lost",
                "refused",
                "in_doubt",
                "unknown",
            ];
            let replies: u64 = reasons.map(|reason| of(&format!("/replies/{reason}"))).iter().sum();
            assert_eq!(replies, of("/replies/due"), "{:#}", self.0);
            let cells = || self.cells().iter().filter(|cell| cell["bus"] == self.0["buses"][bus]["name"]);
            for what in ["due", "in_time", "late"] {
                let each = cells().map(|cell| cell[what].as_u64().unwrap());
                assert_eq!(each.sum::<u64>(), of(&format!("/replies/{what}")), "{what}: {:#}", self.0);
            }
            let missing = cells().flat_map(|cell| cell["missing"].as_object().unwrap().values());
            let missing: u64 = missing.map(|count| count.as_u64().unwrap()).sum();
            assert_eq!(missing, replies - of("/replies/in_time") - of("/replies/late"), "{:#}", self.0);
            let arrived = of("/uplink/delivered") + of("/uplink/rejected") + of("/uplink/unheard");
            let reasons = ["dropped", "backlog", "outage", "hosts", "queues", "unknown"];
            let lost: u64 = reasons.map(|reason| of(&format!("/uplink/{reason}"))).iter().sum();
            assert_eq!(of("/uplink/sent") + of("/uplink/surplus"), arrived + lost, "{:#}", self.0);
            assert_eq!((of("/replies/unknown"), of("/uplink/unknown")), (0, 0), "{:#}", self.0);
            if !self.0["buses"][bus]["sums"].is_null() {
                let ways =
                    ["first", "resent", "overheard", "stale"].map(|route| of(&format!("/sums/{route}")));
                assert_eq!(ways.iter().sum::<u64>(), of("/sums/received"), "{:#}", self.0);
                let of = |how| of(&format!("/sums/contributions/{how}"));
                assert_eq!(of("due"), of("in_time") + of("late") + of("missing"), "{:#}", self.0);
            }
        }
        self
    }
}
