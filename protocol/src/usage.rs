//! Wrong use of a command line, said in one line.

/// What clap says in several lines, in one: what is wrong and its tip, without the usage.
#[must_use]
pub fn one_line(text: &str) -> String {
    let text = text.strip_prefix("error: ").unwrap_or(text);
    let wrong = text.split("\n\nUsage:").flat_map(|text| text.split("\n\nFor more information")).next();
    let lines = wrong.unwrap_or(text).lines().map(str::trim).filter(|line| !line.is_empty());
    let lines = lines.collect::<Vec<_>>().join(" ").replace(" tip: ", "; ");
    format!("{lines}; try '--help'")
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
}
