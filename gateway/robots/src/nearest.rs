//! Suggestions of existing names for mistyped ones.

/// Maximum number of names in a suggestion.
const MAX_SUGGESTIONS: usize = 3;

/// Returns a list of the names that are most similar to a mistyped name, at most three, the most similar first.
pub(crate) fn nearest_names<'a>(target: &str, names: impl IntoIterator<Item = &'a str>) -> String {
    let target = target.to_lowercase();
    let mut found: Vec<_> =
        names.into_iter().map(|name| (edit_distance(&target, &name.to_lowercase()), name)).collect();
    found.sort();
    let found: Vec<_> =
        found.into_iter().take(MAX_SUGGESTIONS).map(|(_, name)| format!("{name:?}")).collect();
    match found.as_slice() {
        [] => "none".to_owned(),
        [one] => one.clone(),
        [first @ .., last] => format!("{} or {last}", first.join(", ")),
    }
}

/// Returns the edit distance of two words: the minimum number of characters to insert, delete or replace.
fn edit_distance(from: &str, to: &str) -> usize {
    let to: Vec<_> = to.chars().collect();
    let mut row: Vec<_> = (0..=to.len()).collect();
    for (above, letter) in from.chars().enumerate() {
        let mut left = above + 1;
        let mut next = vec![left];
        for (pair, other) in row.windows(2).zip(&to) {
            if let [diagonal, up] = *pair {
                left = (diagonal + usize::from(letter != *other)).min(up + 1).min(left + 1);
                next.push(left);
            }
        }
        row = next;
    }
    row.last().copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::{edit_distance, nearest_names};

    #[test]
    fn edits_are_counted() {
        assert_eq!(edit_distance("kitten", "sitting"), 3);
        assert_eq!(edit_distance("", "abc"), 3);
        assert_eq!(edit_distance("abc", ""), 3);
        assert_eq!(edit_distance("same", "same"), 0);
    }

    #[test]
    fn three_names_are_proposed_nearest_first() {
        let names = ["shoulder", "link2", "LINK1", "link11"];
        assert_eq!(nearest_names("link1", names), r#""LINK1", "link11" or "link2""#);
        assert_eq!(nearest_names("x", ["one"]), r#""one""#);
        assert_eq!(nearest_names("x", []), "none");
    }
}
