//! Names that have to be unique where they are written.

use std::collections::BTreeSet;

use protocol::skin::Skin;

/// Names that are taken.
#[derive(Clone, Debug, Default)]
pub struct Taken(BTreeSet<String>);

impl Taken {
    /// Gives out these names, in their order. A name that is taken, also by one before it, gets a number: `name_2`.
    pub fn give(&mut self, requested: Vec<String>) -> Vec<String> {
        let is_free: Vec<_> = requested.iter().map(|name| self.0.insert(name.clone())).collect();
        let numbered = requested.into_iter().zip(is_free);
        numbered.map(|(name, is_free)| if is_free { name } else { self.numbered(&name) }).collect()
    }

    /// Gives out a name.
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

/// A name as a frame or a topic may have it.
#[must_use]
pub fn word(name: &str) -> String {
    name.chars().map(|letter| if letter.is_ascii_alphanumeric() { letter } else { '_' }).collect()
}

/// The words that stand for the chains of a skin in names of links, each another one; empty for an only chain.
#[must_use]
pub fn chain_words(skin: &Skin) -> Vec<String> {
    let chains = &skin.robot.chains;
    if chains.len() < 2 {
        return vec![String::new(); chains.len()];
    }
    Taken::default().give(chains.iter().map(|chain| word(&chain.name)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_taken_name_gets_a_number_that_is_free() {
        let mut taken = Taken::default();
        let given = taken.give(["a", "b", "a", "a_2", "a"].map(str::to_owned).to_vec());
        assert_eq!(given, ["a", "b", "a_3", "a_2", "a_4"]);
        assert_eq!([taken.give_one("b".to_owned()), taken.give_one("c".to_owned())], ["b_2", "c"]);
    }
}
