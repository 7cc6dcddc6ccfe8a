//! Cells on the visual meshes of links: places them for `skinbus skin import --cover`.

use std::ops::RangeInclusive;
use std::path::Path;

use clap::Args;
use cover::{CoverOptions, KeepOut, LinkFigures, MAX_CELLS_PER_BUS, MAX_PITCH, MIN_PITCH, RobotLink, cover};
use protocol::usage::Failure;
use robots::{CellOnLink, Isometry3, Urdf, UrdfChain};

use super::super::print::{comma_separated, count_with_noun};
use super::super::visuals::{PackageOptions, Visuals};

/// Options for the covered links.
#[derive(Args, Debug)]
pub(super) struct CoverArguments {
    /// Place cells on the surfaces of these links, taken from the visuals in the URDF; other links are obstacles
    #[arg(long, value_name = "LINK,..", value_delimiter = ',', value_parser = parse_link_name, conflicts_with = "places")]
    pub(super) cover: Vec<String>,
    /// Distance between the centers of neighbouring cells in m, 0.001 to 1
    #[arg(long, value_name = "M", requires = "cover", default_value_t = 0.028, value_parser = parse_pitch, allow_negative_numbers = true)]
    pitch: f64,
    /// Ignore the visuals of these links, so that cells may be placed where these links are
    #[arg(long, value_name = "LINK,..", requires = "cover", value_delimiter = ',', value_parser = parse_link_name)]
    leave_out: Vec<String>,
    /// Keep this box free of cells: its corners in m, in the frame of a covered link; repeat the option for further
    /// boxes
    #[arg(long, value_name = "LINK:MINX,MINY,MINZ,MAXX,MAXY,MAXZ", requires = "cover", value_parser = keep_out)]
    keep_out: Vec<ExcludedBox>,
    /// Random seed; the same seed places the cells in the same way
    #[arg(long, value_name = "N", requires = "cover", default_value_t = 1)]
    seed: u64,
    /// Maximum number of cells per bus
    #[arg(long, value_name = "N", requires = "cover", default_value_t = 250, value_parser = clap::value_parser!(u8).range(1..=250))]
    nodes_per_bus: u8,
    #[command(flatten)]
    packages: PackageOptions,
}

/// A box in the frame of a link.
#[derive(Clone, Debug)]
struct ExcludedBox {
    link: String,
    min: [f64; 3],
    max: [f64; 3],
    /// Text of the option that gave the box.
    text: String,
}

const PITCH: RangeInclusive<f64> = MIN_PITCH..=MAX_PITCH;

fn parse_pitch(text: &str) -> Result<f64, String> {
    let pitch = text.parse().ok().filter(|pitch| PITCH.contains(pitch));
    pitch.ok_or_else(|| format!("use a length from {MIN_PITCH} to {MAX_PITCH} m"))
}

/// Parses the name of a link, and removes surrounding blanks.
#[expect(clippy::unnecessary_wraps, reason = "a parser of clap's")]
fn parse_link_name(text: &str) -> Result<String, String> {
    Ok(text.trim().to_owned())
}

fn keep_out(text: &str) -> Result<ExcludedBox, String> {
    let parsed = || {
        let (link, numbers) = text.rsplit_once(':')?;
        let numbers =
            numbers.split(',').map(|number| number.trim().parse().ok().filter(|it: &f64| it.is_finite()));
        let numbers: Vec<f64> = numbers.collect::<Option<_>>()?;
        let [min @ .., x, y, z] = numbers.as_slice() else { return None };
        let (min, max) = (<[f64; 3]>::try_from(min).ok()?, [*x, *y, *z]);
        let is_box = min.iter().zip(&max).all(|(min, max)| min <= max);
        is_box.then(|| ExcludedBox { link: link.trim().to_owned(), min, max, text: text.to_owned() })
    };
    parsed().ok_or_else(|| {
        "use a link, a colon, and six lengths in m: the minimum and then the maximum x, y, z of the box"
            .to_owned()
    })
}

/// Cells that cover the links, and figures about them.
pub(super) struct CoverResult {
    pub(super) cells: Vec<CellOnLink>,
    pub(super) figures: Vec<LinkFigures>,
}

impl CoverArguments {
    /// Covers the links with cells. A link belongs to the first chain that moves it, and each bus to one chain.
    pub(super) fn cover_links(
        &self,
        urdf: &Urdf,
        file: &Path,
        chains: &[UrdfChain],
    ) -> Result<CoverResult, Failure> {
        let owners = self.chain_of_each_link(urdf, chains)?;
        let visuals = Visuals::new(urdf, file, &self.packages);
        let there = urdf.links().filter(|name| !self.leave_out.iter().any(|out| out == name));
        let links = there.map(|name| {
            let pose =
                urdf.pose(name, &|joint| urdf.rest_position(joint)).map_err(|error| error.to_string())?;
            let parts = visuals.link_parts(name).map_err(|error| {
                let is_covered = self.cover.iter().any(|covered| covered == name);
                let hint = if is_covered {
                    String::new()
                } else {
                    format!("; or treat it as absent with --leave-out {name}")
                };
                error + &hint
            })?;
            Ok(RobotLink { name: name.to_owned(), parts, pose })
        });
        let links: Vec<_> = links.collect::<Result<_, String>>().map_err(Failure::usage_error)?;
        if let Some(bare) = self
            .cover
            .iter()
            .find(|name| links.iter().any(|link| link.name == **name && link.parts.is_empty()))
        {
            let file = &urdf.file;
            return Err(Failure::usage_error(format!(
                "--cover {bare}: {file} has no visual for this link: add one, or take the link out of --cover"
            )));
        }
        let mut covered = CoverResult { cells: Vec::new(), figures: Vec::new() };
        let mut buses = 0;
        for chain in 0..chains.len() {
            let names: Vec<_> = self
                .cover
                .iter()
                .zip(&owners)
                .filter(|(_, owner)| **owner == chain)
                .map(|(name, _)| name)
                .collect();
            let own: Vec<_> = names
                .iter()
                .filter_map(|name| links.iter().find(|link| link.name == ***name))
                .cloned()
                .collect();
            if own.is_empty() {
                continue;
            }
            let others: Vec<_> = links
                .iter()
                .filter(|link| !link.parts.is_empty() && !names.contains(&&link.name))
                .cloned()
                .collect();
            let skin = cover(&own, &others, &self.options(&own))
                .map_err(|error| Failure::usage_error(format!("--cover: {error}")))?;
            if let Some(bare) = skin.links.iter().find(|figures| figures.cells == 0) {
                let is_flat = own.iter().any(|link| link.name == bare.name && !has_area(link));
                return Err(Failure::usage_error(no_cells_reason(bare, is_flat)));
            }
            covered.cells.extend(skin.cells.iter().map(|cell| CellOnLink {
                link: own.get(cell.link).map_or_else(String::new, |link| link.name.clone()),
                position: cell.position,
                normal: cell.normal,
                bus: Some(format!("vcan{}", buses + cell.bus)),
                node: Some(cell.node),
                neighbors: cell.neighbors,
                root: cell.root,
                line: 0,
            }));
            covered.figures.extend(skin.links);
            buses += skin.buses;
        }
        Ok(covered)
    }

    /// Returns for each covered link the index of its chain.
    fn chain_of_each_link(&self, urdf: &Urdf, chains: &[UrdfChain]) -> Result<Vec<usize>, Failure> {
        let moved = || {
            let on_path = urdf.links().filter(|link| chains.iter().any(|chain| chain.link(link).is_ok()));
            comma_separated(on_path)
        };
        let mut owners = Vec::with_capacity(self.cover.len());
        for (index, name) in self.cover.iter().enumerate() {
            let wrong = |why: String| Failure::usage_error(format!("--cover {name}: {why}"));
            if self.cover.iter().take(index).any(|before| before == name) {
                return Err(wrong("this link is named twice: name it once".to_owned()));
            }
            urdf.pose(name, &|_| 0.0).map_err(|error| wrong(error.to_string()))?;
            let owner = chains.iter().position(|chain| chain.link(name).is_ok());
            owners.push(
                owner.ok_or_else(|| wrong(format!("no chain moves this link: use one of {}", moved())))?,
            );
        }
        for name in &self.leave_out {
            let wrong = |why: String| Failure::usage_error(format!("--leave-out {name}: {why}"));
            urdf.pose(name, &|_| 0.0).map_err(|error| wrong(error.to_string()))?;
            if self.cover.contains(name) {
                return Err(wrong("--cover names this link: take it out of one of them".to_owned()));
            }
        }
        if let Some(lost) = self.keep_out.iter().find(|lost| !self.cover.contains(&lost.link)) {
            let links = comma_separated(&self.cover);
            return Err(Failure::usage_error(format!(
                "--keep-out {}: {} is not covered: the covered links are {links}",
                lost.text, lost.link
            )));
        }
        Ok(owners)
    }

    fn options(&self, links: &[RobotLink]) -> CoverOptions {
        let keep_out = self.keep_out.iter().filter_map(|it| {
            let link = links.iter().position(|link| link.name == it.link)?;
            Some(KeepOut { link, min: it.min, max: it.max })
        });
        CoverOptions {
            pitch: self.pitch,
            seed: self.seed,
            keep_out: keep_out.collect(),
            nodes_per_bus: usize::from(self.nodes_per_bus).min(MAX_CELLS_PER_BUS),
            ..CoverOptions::default()
        }
    }

    /// Returns the options as they were given on the command line.
    pub(super) fn command_options(&self) -> String {
        let Self { cover, pitch, leave_out, keep_out, seed, nodes_per_bus, packages: _ } = self;
        if cover.is_empty() {
            return String::new();
        }
        let mut words = format!(" --cover {} --pitch {pitch}", cover.join(","));
        if !leave_out.is_empty() {
            words += &format!(" --leave-out {}", leave_out.join(","));
        }
        for it in keep_out {
            words += &format!(" --keep-out {}", it.text);
        }
        words + &format!(" --seed {seed} --nodes-per-bus {nodes_per_bus}")
    }
}

/// Returns true if a link has any triangle that is not degenerate.
fn has_area(link: &RobotLink) -> bool {
    let triangles = link.parts.iter().flat_map(|part| part.triangles(&Isometry3::identity()));
    triangles.into_iter().any(|[a, b, c]| (b - a).cross(&(c - a)).norm() > 0.0)
}

/// Returns the reason why a link has no cell, in one line.
fn no_cells_reason(LinkFigures { name, outer_area, kept_out, .. }: &LinkFigures, is_flat: bool) -> String {
    let why = if is_flat {
        "its triangles have no area: correct its meshes, or take it out of --cover".to_owned()
    } else if *outer_area <= 0.0 {
        "other links enclose the whole link: take it out of --cover, or add the others to --leave-out"
            .to_owned()
    } else if *kept_out >= 1.0 {
        "the boxes of --keep-out contain the whole link: make them smaller, or take the link out of --cover"
            .to_owned()
    } else {
        format!("no cell fits on its {outer_area:.4} m2: lower the pitch, or take the link out of --cover")
    };
    format!("--cover {name}: {why}")
}

/// Returns the figures of a covered link, in one line.
pub(super) fn figures_text(figures: &LinkFigures) -> String {
    let LinkFigures { name, cells, outer_area, kept_out: _, covered, spacing, tilt } = figures;
    let spacing =
        spacing.map_or_else(String::new, |metres| format!("; {:.1} mm from cell to cell", metres * 1e3));
    format!(
        "{name}: {}, {:.1} % of {outer_area:.4} m2 covered{spacing}; cells tilted by at most {:.1} degrees",
        count_with_noun(*cells, "cell"),
        covered * 100.0,
        tilt.to_degrees()
    )
}
