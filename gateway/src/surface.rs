//! What a skin's robot looks like: its URDF's links on the rows of the skin's chains.

use std::path::Path;

use cover::Part;
use protocol::skin::{Chain, ChainRow, Skin};
use robots::{Isometry3, LinkFrame, Row, Urdf};

use super::output::note;
use super::print::count;
use super::robot_file::{read_urdf, urdf_of};
use super::visuals::{Packages, Visuals};

/// A part of a link.
#[derive(Clone, Debug)]
pub(crate) struct Placed {
    /// The skin's chain.
    pub(crate) chain: usize,
    /// The row in whose frame it is, from 1; 0 is where the chain begins.
    pub(crate) row: usize,
    /// The part; its pose is from that frame.
    pub(crate) part: Part,
}

/// A robot's URDF beside its skin.
#[derive(Debug)]
pub(crate) struct Surface {
    pub(crate) urdf: Urdf,
    /// The URDF's chains, in the order of the skin's.
    pub(crate) chains: Vec<robots::Chain>,
    pub(crate) parts: Vec<Placed>,
}

impl Surface {
    /// That of the skin in a file; none if it names no URDF. What cannot be drawn is noted.
    pub(crate) fn read(file: &Path, skin: &Skin, packages: &Packages) -> Option<Self> {
        let path = urdf_of(file, skin.robot.urdf.as_deref()?);
        let surface = read_urdf(&path).and_then(|(urdf, _)| Self::of(urdf, &path, skin, packages));
        surface.map_err(|error| note(format_args!("the robot is not drawn: {error}"))).ok()
    }

    fn of(urdf: Urdf, file: &Path, skin: &Skin, packages: &Packages) -> Result<Self, String> {
        let found = skin.robot.chains.iter().map(|chain| {
            chain_of(&urdf, chain).ok_or_else(|| {
                format!(
                    "{} has no chain with the rows of {}: import the skin from it again",
                    urdf.file, chain.name
                )
            })
        });
        let chains = found.collect::<Result<Vec<_>, _>>()?;
        let visuals = Visuals::new(&urdf, file, packages);
        let (mut parts, mut missing) = (Vec::new(), Vec::new());
        for link in urdf.links() {
            match visuals.parts(link) {
                Err(error) => missing.push(error),
                Ok(all) => {
                    let Some((chain, row, frame)) = place(&urdf, &chains, link) else { continue };
                    let put = |part: Part| Part { pose: frame * part.pose, ..part };
                    parts.extend(all.into_iter().map(|part| Placed { chain, row, part: put(part) }));
                }
            }
        }
        if let Some(first) = missing.first() {
            note(format_args!("{} not drawn: {first}", count(missing.len(), "link")));
        }
        Ok(Self { urdf, chains, parts })
    }
}

/// The URDF's chain with the same rows as a skin's.
fn chain_of(urdf: &Urdf, chain: &Chain) -> Option<robots::Chain> {
    // Which link the chain begins at is not in the skin.
    let mut roots = urdf.links().filter_map(|root| urdf.chain(Some(root), &chain.name).ok());
    roots.find(|found| {
        let same = |(one, other): (&ChainRow, &Row)| {
            let other = other.with_limits(one.limits);
            let [one, other] = [one, &other].map(|it| (it.kind, it.table));
            let near = |one: f64, other: f64| (one - other).abs() < 1e-9;
            let (a, b) = (one.1, other.1);
            one.0 == other.0
                && near(a.a, b.a)
                && near(a.d, b.d)
                && near(a.alpha, b.alpha)
                && near(a.theta_offset, b.theta_offset)
        };
        found.rows.len() == chain.rows.len() && chain.rows.iter().zip(&found.rows).all(same)
    })
}

/// The chain and the row that a link is fixed to, and the link's frame in that of the row. Joints that are in no chain are at rest; what
/// no chain moves is fixed to where the first one begins.
fn place(urdf: &Urdf, chains: &[robots::Chain], link: &str) -> Option<(usize, usize, Isometry3<f64>)> {
    let pose = |link: &str| urdf.pose(link, &|joint| urdf.rest(joint)).ok();
    let at = pose(link)?;
    let mut above = Some(link);
    while let Some(carrier) = above {
        let carried =
            chains.iter().enumerate().find_map(|(index, chain)| Some((index, chain.link(carrier).ok()?)));
        if let Some((chain, LinkFrame { row, frame, .. })) = carried {
            return Some((chain, row, frame * pose(carrier)?.inverse() * at));
        }
        above = urdf.parent(carrier);
    }
    let first = chains.first()?;
    Some((0, 0, first.base.inverse() * pose(&first.root)?.inverse() * at))
}
