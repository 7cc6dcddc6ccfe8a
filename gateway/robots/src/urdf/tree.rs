//! Connection of links and joints to a tree.

use std::collections::{BTreeMap, BTreeSet};

use super::{Urdf, UrdfJoint, UrdfLink};
use crate::error::{RobotError, RobotProblem};
use crate::nearest::nearest_names;

/// A joint that is not connected yet: its links are given by name.
pub(super) struct UnlinkedJoint {
    /// The joint. The indices of its parent and child are not set yet.
    pub(super) joint: UrdfJoint,
    /// The name of the parent link.
    pub(super) parent: String,
    /// The name of the child link.
    pub(super) child: String,
}

/// A link, and its line in the file.
pub(super) type LinkWithLine = (UrdfLink, u32);

/// Connects links by joints to a tree. Returns the checked URDF.
pub(super) fn build_tree(
    file: &str,
    name: String,
    placed: Vec<LinkWithLine>,
    loose: Vec<UnlinkedJoint>,
) -> Result<Urdf, RobotError> {
    let error = |line, problem| RobotError::new(file, line, problem);
    let mut names = BTreeMap::new();
    let mut links = Vec::new();
    for (link, line) in placed {
        if names.insert(link.name.clone(), links.len()).is_some() {
            return Err(error(Some(line), RobotProblem::Duplicate { what: "link", name: link.name }));
        }
        links.push(link);
    }
    let mut joints = Vec::<UrdfJoint>::new();
    let mut taken = BTreeSet::new();
    for UnlinkedJoint { mut joint, parent, child } in loose {
        let line = Some(joint.line);
        if !taken.insert(joint.name.clone()) {
            return Err(error(line, RobotProblem::Duplicate { what: "joint", name: joint.name }));
        }
        let find = |role, link: String| {
            names.get(&link).copied().ok_or_else(|| {
                let nearest = nearest_names(&link, names.keys().map(String::as_str));
                error(line, RobotProblem::JointWithoutLink { joint: joint.name.clone(), role, link, nearest })
            })
        };
        (joint.parent, joint.child) = (find("parent", parent)?, find("child", child)?);
        if let Some(link) = links.get_mut(joint.child) {
            if let Some(first) = link.parent.and_then(|index| joints.get(index)) {
                let (link, first) = (link.name.clone(), first.name.clone());
                return Err(error(line, RobotProblem::TwoParents { link, first, second: joint.name }));
            }
            link.parent = Some(joints.len());
        }
        joints.push(joint);
    }
    let mut roots = links.iter().enumerate().filter(|(_, link)| link.parent.is_none());
    let root = roots.next().map(|(index, link)| (index, link.name.clone()));
    if let (Some((_, first)), Some((_, second))) = (&root, roots.next()) {
        let (first, second) = (first.clone(), second.name.clone());
        return Err(error(None, RobotProblem::TwoRoots { first, second }));
    }
    let urdf = Urdf { file: file.to_owned(), name, links, joints, root: root.map_or(0, |(index, _)| index) };
    match find_cycle(&urdf) {
        None => Ok(urdf),
        Some(link) => Err(error(None, RobotProblem::Cycle(link.name.clone()))),
    }
}

/// Returns a link that is its own ancestor; `None` if there is no cycle.
fn find_cycle(urdf: &Urdf) -> Option<&UrdfLink> {
    // For each link met on a path to the root: the link from which that path began.
    let mut walked = vec![None; urdf.links.len()];
    for start in 0..urdf.links.len() {
        let mut at = Some(start);
        while let Some(index) = at {
            match walked.get_mut(index)? {
                Some(from) if *from == start => return urdf.links.get(index),
                Some(_) => break,
                unseen @ None => *unseen = Some(start),
            }
            let parent = urdf.links.get(index).and_then(|link| link.parent);
            at = parent.and_then(|joint| urdf.joints.get(joint)).map(|joint| joint.parent);
        }
    }
    None
}
