//! Escaping of text for XML and HTML.

use crate::usage::is_unprintable;

/// Escapes a text for use between tags and in quoted attributes of XML and HTML. Control and other
/// unprintable characters become U+FFFD, because XML cannot represent most of them; line feeds and tabs are
/// kept.
#[must_use]
pub fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            letter if is_unprintable(letter) && !matches!(letter, '\n' | '\t') => {
                safe.push(char::REPLACEMENT_CHARACTER)
            }
            letter => safe.push(letter),
        }
    }
    safe
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_and_controls_do_no_harm() {
        assert_eq!(escaped("<a b='c' d=\"e\"> & f"), "&lt;a b=&#39;c&#39; d=&quot;e&quot;&gt; &amp; f");
        assert_eq!(escaped("é\t1\n\u{1b}[0m\0\u{202e}\u{fffe}"), "é\t1\n\u{fffd}[0m\u{fffd}\u{fffd}\u{fffd}");
    }
}
