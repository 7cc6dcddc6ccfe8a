//! Appearance of a skin's robot: the shapes of the URDF's links, placed on the rows of the skin's chains.

use std::collections::BTreeMap;
use std::path::Path;

use cover::LinkMesh;
use cover::mesh::{Triangle, simplify};
use protocol::skin::{Chain, ChainRow, Skin};
use robots::{DhRow, Isometry3, LinkFrame, Urdf};
use view::RowMesh;

use super::output::print_note;
use super::print::count_with_noun;
use super::robot_file::{read_urdf, urdf_path};
use super::visuals::{PackageOptions, Visuals};

/// A part of a link's shape, placed on a row of a chain.
struct PlacedPart {
    /// Index of the chain in the skin.
    chain: usize,
    /// Row in whose frame the part is, from 1; 0 is the start of the chain.
    row: usize,
    /// The mesh, with its pose relative to the frame of the row.
    part: LinkMesh,
}

/// Returns the drawing of the robot that a skin's file describes: triangles for each row, simplified to at most `most`
/// in all. The list is empty if the skin names no URDF. Prints a note on parts that cannot be drawn.
pub(crate) fn robot_meshes(file: &Path, skin: &Skin, packages: &PackageOptions, most: usize) -> Vec<RowMesh> {
    let Some(path) = skin.robot.urdf.as_deref().map(|urdf| urdf_path(file, urdf)) else { return Vec::new() };
    let parts = read_urdf(&path).and_then(|(urdf, _)| placed_parts(&urdf, &path, skin, packages));
    let parts = parts
        .map_err(|error| print_note(format_args!("the robot is not drawn: {error}")))
        .unwrap_or_default();
    let mut rows = BTreeMap::<_, Vec<_>>::new();
    for PlacedPart { chain, row, part } in parts {
        rows.entry((chain, row)).or_default().extend(part.triangles(&Isometry3::identity()));
    }
    let (places, triangles): (Vec<_>, Vec<_>) = rows.into_iter().unzip();
    let points = |triangles: Vec<Triangle>| {
        triangles.into_iter().map(|triangle| triangle.map(|corner| corner.coords.into())).collect()
    };
    let shells = places.into_iter().zip(simplify(triangles, most));
    shells.map(|((chain, row), all)| RowMesh { chain, row, triangles: points(all) }).collect()
}

fn placed_parts(
    urdf: &Urdf,
    file: &Path,
    skin: &Skin,
    packages: &PackageOptions,
) -> Result<Vec<PlacedPart>, String> {
    let found = skin.robot.chains.iter().map(|chain| {
        matching_urdf_chain(urdf, chain).ok_or_else(|| {
            format!(
                "{} has no chain that matches the rows of {} in the skin: import the skin from it again",
                urdf.file, chain.name
            )
        })
    });
    let chains = found.collect::<Result<Vec<_>, _>>()?;
    let visuals = Visuals::new(urdf, file, packages);
    let (mut parts, mut missing) = (Vec::new(), Vec::new());
    for link in urdf.links() {
        match visuals.link_parts(link) {
            Err(error) => missing.push(error),
            Ok(all) => {
                let Some((chain, row, frame)) = link_attachment(urdf, &chains, link) else { continue };
                let put = |part: LinkMesh| LinkMesh { pose: frame * part.pose, ..part };
                parts.extend(all.into_iter().map(|part| PlacedPart { chain, row, part: put(part) }));
            }
        }
    }
    if let Some(first) = missing.first() {
        print_note(format_args!("{} not drawn: {first}", count_with_noun(missing.len(), "link")));
    }
    Ok(parts)
}

/// Finds the chain of the URDF that has the same rows as a skin's chain.
fn matching_urdf_chain(urdf: &Urdf, chain: &Chain) -> Option<robots::UrdfChain> {
    // The skin does not say at which link of the URDF the chain begins.
    let mut roots = urdf.links().filter_map(|root| urdf.chain(Some(root), &chain.name).ok());
    roots.find(|found| {
        let same = |(one, other): (&ChainRow, &DhRow)| {
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

/// Returns the index of the chain and the row to which a link is fixed, and the pose of the link in the row's frame.
/// Joints outside all chains are at rest. Links that no chain moves are fixed to the start of the first chain.
fn link_attachment(
    urdf: &Urdf,
    chains: &[robots::UrdfChain],
    link: &str,
) -> Option<(usize, usize, Isometry3<f64>)> {
    let pose = |link: &str| urdf.pose(link, &|joint| urdf.rest_position(joint)).ok();
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
