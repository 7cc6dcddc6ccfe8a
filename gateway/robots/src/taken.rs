//! Unique names for output.

use std::collections::BTreeSet;

use protocol::skin::Skin;

/// A set of used names.
#[derive(Clone, Debug, Default)]
pub struct UniqueNames(BTreeSet<String>);

impl UniqueNames {
    /// Returns unique names for the requested ones, in their order. A name that is already used, also by an earlier one
    /// in the list, gets a number: `name_2`.
    pub fn give(&mut self, requested: Vec<String>) -> Vec<String> {
        let is_free: Vec<_> = requested.iter().map(|name| self.0.insert(name.clone())).collect();
        let numbered = requested.into_iter().zip(is_free);
        numbered.map(|(name, is_free)| if is_free { name } else { self.numbered(&name) }).collect()
    }

    /// Returns a unique name for the requested one.
    pub fn give_one(&mut self, name: String) -> String {
        if self.0.insert(name.clone()) { name } else { self.numbered(&name) }
    }

    fn numbered(&mut self, name: &str) -> String {
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

/// Replaces characters of a name that frames and topics do not allow.
#[must_use]
pub fn word(name: &str) -> String {
    name.chars().map(|letter| if letter.is_ascii_alphanumeric() { letter } else { '_' }).collect()
}

/// Returns unique words for the chains of a skin in the names of links; empty if there is only one chain.
#[must_use]
pub fn chain_words(skin: &Skin) -> Vec<String> {
    let chains = &skin.robot.chains;
    if chains.len() < 2 {
        return vec![String::new(); chains.len()];
    }
    UniqueNames::default().give(chains.iter().map(|chain| word(&chain.name)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_taken_name_gets_a_number_that_is_free() {
        let mut taken = UniqueNames::default();
        let given = taken.give(["a", "b", "a", "a_2", "a"].map(str::to_owned).to_vec());
        assert_eq!(given, ["a", "b", "a_3", "a_2", "a_4"]);
        assert_eq!([taken.give_one("b".to_owned()), taken.give_one("c".to_owned())], ["b_2", "c"]);
    }
}
