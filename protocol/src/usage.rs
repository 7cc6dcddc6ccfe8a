//! Command lines: wrong use, said in one line, and words that can be typed again.

use std::borrow::Cow;

/// What clap says in several lines, in one: what is wrong and its tip, without the usage.
#[must_use]
pub fn one_line(text: &str) -> String {
    let text = text.strip_prefix("error: ").unwrap_or(text);
    let wrong = text.split("\n\nUsage:").flat_map(|text| text.split("\n\nFor more information")).next();
    let lines = wrong.unwrap_or(text).lines().map(str::trim).filter(|line| !line.is_empty());
    let lines = lines.collect::<Vec<_>>().join(" ").replace(" tip: ", "; ");
    format!("{lines}; try '--help'")
}

/// A word as a shell takes it: as it is, or in quotes.
#[must_use]
pub fn quoted(word: &str) -> Cow<'_, str> {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"_-./:=,@%+".contains(&byte);
    if !word.is_empty() && word.bytes().all(plain) {
        return Cow::Borrowed(word);
    }
    let quote = "'\\''";
    Cow::Owned(format!("'{}'", word.replace('\'', quote)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_wrong_and_its_tip_remain() {
        let said = "error: unexpected argument '--nod' found\n\n  tip: a similar argument exists: '--node'\n\n\
                    Usage: cell-node --bus <NAME>\n\nFor more information, try '--help'.\n";
        let expected =
            "unexpected argument '--nod' found ; a similar argument exists: '--node'; try '--help'";
        assert_eq!(one_line(said), expected.replace(" ; ", "; "));
        let said = "error: invalid value 'x' for '--node'\n\nFor more information, try '--help'.\n";
        assert_eq!(one_line(said), "invalid value 'x' for '--node'; try '--help'");
    }
    #[test]
    fn a_word_can_be_typed_again() {
        for plain in ["vcan0", "/tmp/a-b_c.toml", "--peer=x"] {
            assert_eq!(quoted(plain), plain);
        }
        assert_eq!(quoted("a b.toml"), "'a b.toml'");
        assert_eq!(quoted("it's $HOME"), r"'it'\''s $HOME'");
        assert_eq!(quoted(""), "''");
    }
}
