//! The section on the skin: touches over time and by position, and the cells with lost replies and packets.

use std::collections::BTreeMap;

use model::surface::lay_flat;

use super::super::bus_figures::BusFigures;
use super::PageDraft;
use crate::report::figure::{
    CellMap, CellStrip, ColourLegend, Drawing, LinkPanel, MapCell, Section, StripGroup, StripRow,
    format_quantity,
};

/// Maximum number of rows of the strip of touched cells.
const MAX_STRIP_ROWS: usize = 40;

/// A link of the robot: the index of a chain, and a row of it from 1.
type ChainRow = (usize, u8);

impl PageDraft<'_> {
    /// Creates the section on touches, with their times and forces.
    pub(super) fn touch_section(&self) -> Section {
        let section = Section::new("skin", "The skin");
        let forces = self.values_by_cell(|bus, place| {
            self.run.bus_figures.get(bus).and_then(|it| it.touched.max.get(place)).copied().flatten()
        });
        let losses = self.values_by_cell(|bus, place| {
            let cell = self.run.bus_figures.get(bus)?.table.cells().get(place)?;
            Some((cell.replies.late + cell.replies.missing + cell.uplink().lost) as f64)
        });
        let title =
            "Largest force on each cell, seen from outside; links are unrolled, with the tip at the bottom";
        let force = self.cell_map("map-force", title, "force", "N", &forces);
        let title = "Late and missing replies and lost packets, by cell";
        let loss = self.cell_map("map-losses", title, "losses", "", &losses);
        let section = match (self.touch_strip(), force) {
            (Some(strip), Some(force)) => section
                .with_paragraph(
                    "Algorithm 1 computes each force from the cell's sensors. A joints message latches the force, which is \
                     used until the next joints message.",
                )
                .with_drawings([Drawing::Strip(strip), Drawing::Map(force)])
                .with_tables(self.touch_table()),
            (..) if self.lacks_forces() => section.with_paragraph(
                self.missing_sentence(
                    "the stimuli or sensors of the cells that sent torques, which show the forces on them",
                )
                .unwrap_or_default(),
            ),
            (..) => section.with_paragraph("The frames show no touch of a cell."),
        };
        let sums = self.run.bus_figures.iter().any(|bus_figures| bus_figures.sums);
        match (loss, sums) {
            (Some(loss), _) => section.with_drawings([Drawing::Map(loss)]),
            (None, false) => {
                section.with_paragraph("No cell's reply was late or missing, and no packet of a cell was lost.")
            }
            (None, true) => section.with_paragraph(
                "No packet of a cell was lost. Frames do not show which cells were late or missing in a sum, so there is no \
                 map of them.",
            ),
        }
    }

    /// Returns true for a capture with frames only in which cells sent torques, but the forces on them are unknown.
    pub(super) fn lacks_forces(&self) -> bool {
        let lines = self.run.motion.distributed.iter();
        let is_loaded = lines.flat_map(|line| line.points()).any(|(_, torque)| torque != 0.0);
        let is_untouched = |it: &BusFigures| it.touched.touch_bins_by_cell().next().is_none();
        self.run.frames_only.is_some() && is_loaded && self.run.bus_figures.iter().all(is_untouched)
    }

    /// Creates the strip of touched cells over time.
    fn touch_strip(&self) -> Option<CellStrip> {
        let mut rows = Vec::new();
        for (bus, bus_figures) in self.run.bus_figures.iter().enumerate() {
            let nodes: Vec<_> = self.run.skin.cells_on_bus(bus).collect();
            for (place, values) in bus_figures.touched.touch_bins_by_cell() {
                let Some(cell) = nodes.get(place) else { continue };
                let max = values.iter().map(|value| value.2).fold(0.0, f64::max);
                let values =
                    values.into_iter().map(|(from, to, force)| (from - self.zero, to - self.zero, force));
                let row = StripRow { caption: cell.node.to_string(), values: values.collect() };
                let chain = self.run.skin.buses.get(bus).map_or(0, |bus| bus.chain);
                rows.push(((chain, cell.row, bus, cell.node), max, row));
            }
        }
        let touched = rows.len();
        if touched == 0 {
            return None;
        }
        rows.sort_by(|one, other| other.1.total_cmp(&one.1).then(one.0.cmp(&other.0)));
        let rest = rows.split_off(touched.min(MAX_STRIP_ROWS));
        let legend = ColourLegend::for_values("force", "N", rows.iter().map(|(_, max, _)| *max));
        let title = match rest.first() {
            None => {
                format!("Force over time on the {touched} touched cells (of {})", self.run.skin.cells.len())
            }
            Some((_, max, _)) => format!(
                "Force over time on the {MAX_STRIP_ROWS} cells with the largest forces; {} more were touched, with at most {}",
                rest.len(),
                format_quantity(*max, "N")
            ),
        };
        rows.sort_by_key(|(key, ..)| *key);
        let mut groups: Vec<((ChainRow, usize), StripGroup)> = Vec::new();
        for ((chain, row, bus, _), _, of_cell) in rows {
            let key = ((chain, row), bus);
            if groups.last().is_none_or(|(last, _)| *last != key) {
                let title = self.link_name((chain, row), Some(bus));
                groups.push((key, StripGroup { title, rows: Vec::new() }));
            }
            if let Some((_, group)) = groups.last_mut() {
                group.rows.push(of_cell);
            }
        }
        let groups = groups.into_iter().map(|(_, group)| group).collect();
        let seconds = (0.0, self.run.motion.duration_s());
        Some(CellStrip { name: "touches".to_owned(), title, seconds, legend, groups })
    }

    /// Returns one value for each cell in the skin's order. `value` computes it from the index of the bus and the index
    /// of the cell on the bus.
    fn values_by_cell(&self, value: impl Fn(usize, usize) -> Option<f64>) -> Vec<Option<f64>> {
        let mut places = vec![0; self.run.skin.buses.len()];
        let of = |cell: &protocol::skin::Cell| {
            let place = places.get_mut(cell.bus)?;
            *place += 1;
            value(cell.bus, *place - 1)
        };
        self.run.skin.cells.iter().map(of).collect()
    }

    /// Creates a map of the cells with their values; `None` if all of them are 0.
    fn cell_map(
        &self,
        name: &str,
        title: &str,
        caption: &str,
        unit: &str,
        values: &[Option<f64>],
    ) -> Option<CellMap> {
        let skin = &self.run.skin;
        let legend = ColourLegend::for_values(caption, unit, values.iter().copied().flatten());
        if legend.max <= 0.0 {
            return None;
        }
        let mut links = BTreeMap::<ChainRow, Vec<_>>::new();
        for (cell, value) in skin.cells.iter().zip(values) {
            let chain = skin.buses.get(cell.bus).map_or(0, |bus| bus.chain);
            links.entry((chain, cell.row)).or_default().push((cell, *value));
        }
        let panels = links.into_iter().map(|(link, cells)| {
            let placed: Vec<_> = cells.iter().map(|(cell, _)| (cell.position, cell.normal)).collect();
            let flat = lay_flat(&placed, self.tip_direction(link));
            let spots = cells.iter().zip(flat.places).map(|((cell, value), at)| {
                let bus = skin.buses.get(cell.bus).map_or("", |bus| &bus.name);
                MapCell { at, value: *value, caption: format!("{bus} {}", cell.node) }
            });
            LinkPanel { title: self.link_name(link, None), radius: flat.radius, cells: spots.collect() }
        });
        let panels = panels.collect();
        Some(CellMap { name: name.to_owned(), title: title.to_owned(), legend, panels })
    }

    /// Returns the direction from the previous link to this one, in this link's frame.
    fn tip_direction(&self, (chain, row): ChainRow) -> [f64; 3] {
        let rows = self.run.skin.robot.chains.get(chain).map(|chain| &chain.rows);
        let row = rows.and_then(|rows| rows.get(usize::from(row).saturating_sub(1)));
        row.map_or([0.0, 0.0, 1.0], |row| {
            let (sine, cosine) = row.table.alpha.sin_cos();
            [row.table.a, row.table.d * sine, row.table.d * cosine]
        })
    }

    /// Returns the name of a link, with its bus if there are several.
    pub(super) fn link_name(&self, (chain, row): ChainRow, bus: Option<usize>) -> String {
        let skin = &self.run.skin;
        let chains = &skin.robot.chains;
        let of_chain = chains.get(chain).filter(|_| chains.len() > 1);
        let of_chain = of_chain.map_or_else(String::new, |chain| format!("{}, ", chain.name));
        let bus = bus.filter(|_| skin.buses.len() > 1).and_then(|bus| skin.buses.get(bus));
        let bus = bus.map_or_else(String::new, |bus| format!(", {}", bus.name));
        format!("{of_chain}link {row}{bus}")
    }
}
