//! Random damage to networks: each damage is reported, and nothing else.

use std::collections::VecDeque;

use proptest::prelude::*;
use proptest::sample::Index;
use protocol::message::PortState;
use protocol::skin::Skin;

use super::*;

fn cell(node: usize) -> CellId {
    CellId::new(i64::try_from(node).unwrap()).unwrap()
}

fn serial(node: CellId) -> u32 {
    500 + u32::from(node.get())
}

/// The hash of every cell's configuration.
const HASH: u16 = 0x1234;

/// Returns a skin whose cells have these neighbours at their ports; the first cell is a root.
fn skin(neighbors: &[[usize; PORTS]]) -> Skin {
    let head =
        crate::testing::ONE_CELL_SKIN_TOML.replace("reply = \"torque\"", "reply = \"sum\"\nslot_us = 100");
    let (head, one) = head.split_at(head.find("[[cell]]").unwrap());
    let cells = neighbors.iter().enumerate().map(|(at, ports)| {
        let (node, root) = (at + 1, at == 0);
        let keys =
            format!("node = {node}\nserial = {}\nroot = {root}\nneighbors = {ports:?}", serial(cell(node)));
        one.replace("node = 1", &keys)
    });
    let text = format!("{head}{}", cells.collect::<String>());
    Skin::parse("skin.toml", &text).unwrap_or_else(|error| panic!("{error}"))
}

/// The actual cells and wires of a network, damaged at random.
struct Truth {
    wires: BusWires,
    cells: usize,
    /// For each end, the end at which its messages arrive.
    leads: BTreeMap<WireEnd, WireEnd>,
    dead: BTreeSet<CellId>,
    beats: BTreeMap<CellId, Heartbeat>,
    versions: BTreeMap<CellId, u16>,
    /// Cells that must not be damaged again.
    touched: BTreeSet<CellId>,
    expected: BTreeSet<Difference>,
}

impl Truth {
    fn new(skin: &Skin) -> Self {
        let wires = skin.wires(0);
        let nodes: Vec<_> = skin.cells.iter().map(|cell| cell.node).collect();
        let ends = nodes.iter().flat_map(|&cell| (0..PORTS).map(move |port| WireEnd { cell, port }));
        let leads = ends.filter_map(|end| {
            let (cell, port) = wires.other_end(end.cell, end.port)?;
            Some((end, WireEnd { cell, port }))
        });
        let leads = leads.collect();
        let beat = |&node: &CellId| {
            let state = State::CONFIGURED.with_joint(3);
            (node, Heartbeat { serial: serial(node), configuration: HASH, sent: 1, rejected: 0, state })
        };
        Self {
            cells: nodes.len(),
            wires,
            leads,
            dead: BTreeSet::new(),
            beats: nodes.iter().map(beat).collect(),
            versions: BTreeMap::new(),
            touched: BTreeSet::new(),
            expected: BTreeSet::new(),
        }
    }

    fn touch(&mut self, cells: &[CellId]) -> bool {
        let free = cells.iter().all(|cell| !self.touched.contains(cell));
        if free {
            self.touched.extend(cells);
        }
        free
    }

    fn is_free(&self, end: WireEnd) -> bool {
        self.wires.other_end(end.cell, end.port).is_none()
    }

    fn free_port(&self, cell: CellId) -> Option<WireEnd> {
        (0..PORTS).map(|port| WireEnd { cell, port }).find(|&end| self.is_free(end))
    }

    fn damage(&mut self, kind: u8, at: &Index, other: &Index) {
        let node = cell(at.index(self.cells) + 1);
        let wires: Vec<(WireEnd, WireEnd)> =
            self.leads.iter().map(|(a, b)| (*a, *b)).filter(|(a, b)| a < b).collect();
        let wire = |index: &Index| wires.get(index.index(wires.len().max(1))).copied();
        match kind {
            0..=2 => {
                let Some((first, second)) = wire(at).filter(|(a, b)| self.touch(&[a.cell, b.cell])) else {
                    return;
                };
                let carries = match kind {
                    0 => WorkingDirection::Nothing,
                    1 => WorkingDirection::There,
                    _ => WorkingDirection::Back,
                };
                if carries != WorkingDirection::There {
                    self.leads.remove(&first);
                }
                if carries != WorkingDirection::Back {
                    self.leads.remove(&second);
                }
                self.expected.insert(Difference::MissingWire { first, second, carries });
            }
            3 => {
                let second = cell(other.index(self.cells) + 1);
                let Some((a, b)) = self.free_port(node).zip(self.free_port(second)).filter(|(a, b)| a != b)
                else {
                    return;
                };
                if node != second && self.touch(&[node, second]) {
                    self.leads.extend([(a, b), (b, a)]);
                    self.expected.insert(Difference::ExtraWire(a.min(b), a.max(b)));
                }
            }
            4 => {
                let Some(((a, b), (c, d))) = wire(at).zip(wire(other)) else { return };
                let all = BTreeSet::from([a.cell, b.cell, c.cell, d.cell]);
                let all: Vec<_> = all.into_iter().collect();
                if (a, b) == (c, d) || all.len() < 4 || !self.touch(&all) {
                    return;
                }
                for (x, y, of_x, of_y) in [(a, d, b, c), (c, b, d, a)] {
                    self.leads.extend([(x, y), (y, x)]);
                    let (end, leads, described) = if x < y { (x, y, of_x) } else { (y, x, of_y) };
                    self.expected.insert(Difference::SwappedWire { end, leads, described });
                }
            }
            5 => {
                // Move a plug to a wrong port of the right cell.
                let Some((a, b)) = wire(at) else { return };
                let Some(wrong) = self.free_port(b.cell) else { return };
                if self.touch(&[a.cell, b.cell]) {
                    self.leads.remove(&b);
                    self.leads.extend([(a, wrong), (wrong, a)]);
                    self.expected.insert(Difference::SwappedWire { end: a, leads: wrong, described: b });
                }
            }
            6 => {
                if node != cell(1) && self.touch(&[node]) {
                    self.dead.insert(node);
                    self.expected.insert(Difference::MissingCell(node));
                }
            }
            7 => {
                if node != cell(1) && self.touch(&[node]) {
                    let version = 2 + u16::from(kind & 1);
                    self.versions.insert(node, version);
                    let state = &mut self.beats.get_mut(&node).unwrap().state;
                    state.0 = (state.0 & 0x0FFF) | version << 12;
                    self.expected.insert(Difference::Version { cell: node, version: Some(version) });
                }
            }
            8 => {
                if self.touch(&[node]) {
                    let state = &mut self.beats.get_mut(&node).unwrap().state;
                    *state = state.with_flags(State::DUPLICATE, true);
                    self.expected.insert(Difference::Duplicate(node));
                }
            }
            9 => {
                if self.touch(&[node]) {
                    self.beats.get_mut(&node).unwrap().configuration ^= 1;
                    self.expected.insert(Difference::OtherSkin(node));
                }
            }
            10 => {
                if self.touch(&[node]) {
                    self.beats.get_mut(&node).unwrap().serial = 9;
                    let described = serial(node);
                    self.expected.insert(Difference::OtherCell {
                        cell: node,
                        serial: 9,
                        described,
                        belongs: None,
                    });
                }
            }
            _ => {
                let cell = cell(200 + at.index(20));
                self.beats.insert(cell, Heartbeat { serial: 7, ..Heartbeat::default() });
                self.expected.insert(Difference::ExtraCell { cell, serial: 7 });
            }
        }
    }

    fn sends(&self, cell: CellId) -> bool {
        !self.dead.contains(&cell)
    }

    fn works(&self, end: WireEnd) -> Option<WireEnd> {
        let other = *self.leads.get(&end)?;
        let ours = |cell| self.sends(cell) && !self.versions.contains_key(&cell);
        (self.leads.get(&other) == Some(&end) && ours(end.cell) && ours(other.cell)).then_some(other)
    }

    /// Returns the tree that cells would build, breadth first.
    fn trees(&self) -> BTreeMap<CellId, TreePage> {
        let mut trees = BTreeMap::new();
        let mut next =
            VecDeque::from([(cell(1), TreePage { parent: Some(0), parent_port: 4, ..TreePage::default() })]);
        while let Some((node, tree)) = next.pop_front() {
            if trees.contains_key(&node) {
                continue;
            }
            trees.insert(node, tree);
            for other in (0..PORTS).filter_map(|port| self.works(WireEnd { cell: node, port })) {
                let up = u8::try_from(other.port).unwrap();
                let depth = tree.depth + 1;
                next.push_back((
                    other.cell,
                    TreePage { parent: Some(node.get()), parent_port: up, depth, ..TreePage::default() },
                ));
            }
        }
        trees
    }

    fn seen(&mut self) -> Vec<ObservedCell> {
        let trees = self.trees();
        let ports = |cell| {
            let mut ports = [PortState::default(); PORTS];
            for (port, state) in ports.iter_mut().enumerate() {
                let end = WireEnd { cell, port };
                // A port receives if a cell sends towards it.
                let from = self.leads.iter().find(|(from, to)| **to == end && self.sends(from.cell));
                let Some((from, _)) = from else { continue };
                *state = PortState {
                    number: from.cell.get(),
                    port: u8::try_from(from.port).unwrap(),
                    receives: true,
                    works: self.leads.contains_key(&end),
                    other_version: self.versions.contains_key(&from.cell)
                        || self.versions.contains_key(&cell),
                };
            }
            PortsPage { ports, changes: 0 }
        };
        let seen = |(&node, &heartbeat): (&CellId, &Heartbeat)| {
            let described = usize::from(node.get()) <= self.cells;
            let alive = self.sends(node);
            ObservedCell {
                node,
                serial: described.then(|| serial(node)),
                configuration: HASH,
                heartbeat: Some(heartbeat),
                alive,
                tree: described.then(|| trees.get(&node).copied().unwrap_or_default()),
                ports: Some(ports(node)),
            }
        };
        let seen: Vec<_> = self.beats.iter().map(seen).collect();
        let lost = |cell: &&ObservedCell| {
            cell.alive
                && cell.serial.is_some()
                && !trees.contains_key(&cell.node)
                && !self.versions.contains_key(&cell.node)
        };
        let lost: Vec<_> = seen.iter().filter(lost).map(|cell| cell.node).collect();
        if !lost.is_empty() {
            self.expected.insert(Difference::Unreachable(lost));
        }
        seen
    }
}

/// Generates wirings in which every cell has a route to the first.
fn wiring() -> impl Strategy<Value = Vec<[usize; PORTS]>> {
    let parents = proptest::collection::vec(any::<Index>(), 1..14);
    let more = proptest::collection::vec((any::<Index>(), any::<Index>()), 0..10);
    (parents, more).prop_map(|(parents, more)| {
        let mut cells = vec![[0; PORTS]];
        let free = |cells: &[[usize; PORTS]], at: usize| cells[at].iter().position(|&neighbor| neighbor == 0);
        for parent in parents {
            let open: Vec<_> = (0..cells.len()).filter(|&at| free(&cells, at).is_some()).collect();
            let at = open[parent.index(open.len())];
            let port = free(&cells, at).unwrap();
            cells[at][port] = cells.len() + 1;
            cells.push([at + 1, 0, 0, 0]);
        }
        for (a, b) in more {
            let (a, b) = (a.index(cells.len()), b.index(cells.len()));
            if let (true, Some(p), Some(q)) = (a != b, free(&cells, a), free(&cells, b)) {
                cells[a][p] = b + 1;
                cells[b][q] = a + 1;
            }
        }
        cells
    })
}

proptest! {
    #[test]
    fn every_damage_is_named_and_nothing_else(
        neighbors in wiring(),
        damages in proptest::collection::vec((0_u8..12, any::<Index>(), any::<Index>()), 0..6),
    ) {
        let skin = skin(&neighbors);
        let mut truth = Truth::new(&skin);
        for (kind, at, other) in &damages {
            truth.damage(*kind, at, other);
        }
        let seen = truth.seen();
        let found = differences(&truth.wires, &seen);
        let named: BTreeSet<_> = found.iter().cloned().collect();
        prop_assert_eq!(named.len(), found.len(), "each once: {:?}", found);
        prop_assert_eq!(&named, &truth.expected);
        for difference in &found {
            let line = difference.to_string();
            prop_assert!(!line.contains('\n') && line.len() > 20, "{}", line);
        }
    }
}

#[test]
fn a_circle_is_named_by_its_cells_and_cells_below_it_are_unreachable() {
    let skin = skin(&[[2, 0, 0, 0], [1, 3, 4, 0], [2, 4, 0, 0], [2, 3, 5, 0], [4, 0, 0, 0]]);
    let mut truth = Truth::new(&skin);
    let mut seen = truth.seen();
    assert_eq!(differences(&truth.wires, &seen), []);
    let mut parent = |node: usize, parent: u8| {
        let cell = seen.iter_mut().find(|seen| seen.node == cell(node)).unwrap();
        cell.tree.as_mut().unwrap().parent = Some(parent);
    };
    parent(2, 3);
    parent(3, 4);
    parent(4, 2);
    let found = differences(&truth.wires, &seen);
    assert_eq!(
        found,
        [Difference::Circle(vec![cell(2), cell(3), cell(4)]), Difference::Unreachable(vec![cell(5)])]
    );
    assert!(found.iter().all(Difference::breaks_the_tree));
}

#[test]
fn exchanged_cells_and_cells_without_a_node_id_are_named() {
    let skin = skin(&[[2, 0, 0, 0], [1, 0, 0, 0]]);
    let mut truth = Truth::new(&skin);
    let mut seen = truth.seen();
    seen[1].heartbeat.as_mut().unwrap().serial = serial(cell(1));
    seen[1].ports.as_mut().unwrap().ports[2] = PortState { receives: true, ..PortState::default() };
    let lines: Vec<_> = differences(&truth.wires, &seen).iter().map(ToString::to_string).collect();
    assert_eq!(
        lines,
        [
            "the cell with serial number 501 uses node id 2, but in the skin it is cell 1: swap the cells, or their \
             serial numbers in the skin",
            "a cell without a node id is wired to port 2 of cell 2: it takes part once the network has assigned \
             it a free node id",
        ]
    );
}

#[test]
fn a_wire_that_works_in_one_direction_says_which() {
    let ends = |carries: WorkingDirection| carries.describe(cell(2), cell(5));
    assert_eq!(ends(WorkingDirection::Nothing), "does not work");
    assert_eq!(ends(WorkingDirection::There), "works only from cell 2 to cell 5");
    assert_eq!(ends(WorkingDirection::Back), "works only from cell 5 to cell 2");
}
