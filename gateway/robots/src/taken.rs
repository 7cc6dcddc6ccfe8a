//! Unique names for the links and joints of written files.

use std::collections::BTreeSet;

use protocol::skin::Skin;

/// The set of names that are already in use.
#[derive(Clone, Debug, Default)]
pub struct UniqueNames(BTreeSet<String>);

impl UniqueNames {
    /// Returns a unique name for each requested one, in order. A name that is already in use, possibly by an earlier
    /// name of the list, gets a number: `name_2`.
    pub fn assign_unique_names(&mut self, requested: Vec<String>) -> Vec<String> {
        let is_free: Vec<_> = requested.iter().map(|name| self.0.insert(name.clone())).collect();
        let numbered = requested.into_iter().zip(is_free);
        numbered.map(|(name, is_free)| if is_free { name } else { self.add_numbered_name(&name) }).collect()
    }

    /// Returns a unique name for the requested name, and records it as used.
    pub fn assign(&mut self, name: String) -> String {
        if self.0.insert(name.clone()) { name } else { self.add_numbered_name(&name) }
    }

    fn add_numbered_name(&mut self, name: &str) -> String {
        let mut number = 2_u64;
        loop {
            let other = format!("{name}_{number}");
            if self.0.insert(other.clone()) {
                return other;
            }
            number += 1;
        }
    }
}

/// Replaces the characters of a name that are not allowed in names of frames and topics.
#[must_use]
pub fn sanitized(name: &str) -> String {
    name.chars().map(|letter| if letter.is_ascii_alphanumeric() { letter } else { '_' }).collect()
}

/// Returns a unique word for each chain of a skin, to be used in names of links. The words are empty if there is only
/// one chain.
#[must_use]
pub fn chain_prefixes(skin: &Skin) -> Vec<String> {
    let chains = &skin.robot.chains;
    if chains.len() < 2 {
        return vec![String::new(); chains.len()];
    }
    UniqueNames::default().assign_unique_names(chains.iter().map(|chain| sanitized(&chain.name)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_taken_name_gets_a_number_that_is_free() {
        let mut taken = UniqueNames::default();
        let given = taken.assign_unique_names(["a", "b", "a", "a_2", "a"].map(str::to_owned).to_vec());
        assert_eq!(given, ["a", "b", "a_3", "a_2", "a_4"]);
        assert_eq!([taken.assign("b".to_owned()), taken.assign("c".to_owned())], ["b_2", "c"]);
    }
}
