//! Division of an XML text into tags and other parts, in one pass. Malformed text is divided as well.

use std::ops::Range;

/// A part of an XML text.
#[derive(Clone, Debug, Eq, PartialEq)]
pub(super) enum XmlPart<'a> {
    Comment(Range<usize>),
    /// A document type: `<!DOCTYPE ...>`.
    DocType(Range<usize>),
    /// A start tag.
    Open(Tag<'a>),
    /// An end tag.
    Close(Range<usize>),
    Text(Range<usize>),
    /// A declaration, an instruction, or CDATA.
    Other,
}

#[derive(Clone, Debug, Eq, PartialEq)]
pub(super) struct Tag<'a> {
    pub(super) range: Range<usize>,
    pub(super) name: &'a str,
    /// Names of the attributes.
    pub(super) attributes: Vec<&'a str>,
    /// True for an element without content, `<name/>`.
    pub(super) is_empty: bool,
}

/// Returns the parts in the order of the text.
pub(super) fn xml_parts(text: &str) -> impl Iterator<Item = XmlPart<'_>> {
    let mut at = 0;
    core::iter::from_fn(move || {
        let rest = text.get(at..).filter(|rest| !rest.is_empty())?;
        let (part, length) = split_first_part(rest, at);
        at += length;
        Some(part)
    })
}

/// Returns the first part of `rest`, and its length in bytes.
fn split_first_part(rest: &str, at: usize) -> (XmlPart<'_>, usize) {
    let until = |end: &str, from: usize| {
        let found = rest.get(from..).and_then(|rest| rest.find(end));
        found.map_or(rest.len(), |found| from + found + end.len())
    };
    if !rest.starts_with('<') {
        let length = rest.find('<').unwrap_or(rest.len());
        return (XmlPart::Text(at..at + length), length);
    }
    if rest.starts_with("<!--") {
        let length = until("-->", 4);
        return (XmlPart::Comment(at..at + length), length);
    }
    if rest.starts_with("<![CDATA[") {
        return (XmlPart::Other, until("]]>", 9));
    }
    if rest.starts_with("<?") {
        return (XmlPart::Other, until("?>", 2));
    }
    if rest.starts_with("</") {
        let length = until(">", 2);
        return (XmlPart::Close(at..at + length), length);
    }
    if rest.get(..9).is_some_and(|word| word.eq_ignore_ascii_case("<!DOCTYPE")) {
        let length = doctype_length(rest);
        return (XmlPart::DocType(at..at + length), length);
    }
    parse_tag(rest, at)
}

/// Returns the length in bytes of a document type. Its definitions are in brackets; brackets and `>` in quotes do not
/// count.
fn doctype_length(rest: &str) -> usize {
    let (mut quote, mut depth) = (None, 0_usize);
    for (index, byte) in rest.bytes().enumerate() {
        match (quote, byte) {
            (Some(open), _) => quote = Some(open).filter(|open| *open != byte),
            (None, b'"' | b'\'') => quote = Some(byte),
            (None, b'[') => depth += 1,
            (None, b']') => depth = depth.saturating_sub(1),
            (None, b'>') if depth == 0 => return index + 1,
            (None, _) => {}
        }
    }
    rest.len()
}

fn parse_tag(rest: &str, at: usize) -> (XmlPart<'_>, usize) {
    let bytes = rest.as_bytes();
    let ends_name = |byte: u8| byte.is_ascii_whitespace() || matches!(byte, b'>' | b'/' | b'=' | b'<');
    let skip = |from: usize, is: &dyn Fn(u8) -> bool| {
        let rest = bytes.get(from..).unwrap_or_default();
        rest.iter().position(|byte| !is(*byte)).map_or(bytes.len(), |length| from + length)
    };
    let mut end = skip(1, &|byte| !ends_name(byte));
    let name = rest.get(1..end).unwrap_or_default();
    let mut attributes = Vec::new();
    let mut is_empty = false;
    loop {
        end = skip(end, &|byte| byte.is_ascii_whitespace());
        match bytes.get(end) {
            None | Some(b'<') => break,
            Some(b'>') => {
                end += 1;
                break;
            }
            Some(b'/') => {
                is_empty = bytes.get(end + 1) == Some(&b'>');
                end += 1;
            }
            Some(quote @ (b'"' | b'\'')) => {
                end = skip(end + 1, &|byte| byte != *quote).saturating_add(1).min(bytes.len());
            }
            Some(b'=') => end += 1,
            Some(_) => {
                let begin = end;
                end = skip(end, &|byte| !ends_name(byte) && !matches!(byte, b'"' | b'\''));
                attributes.push(rest.get(begin..end).unwrap_or_default());
            }
        }
    }
    (XmlPart::Open(Tag { range: at..at + end, name, attributes, is_empty }), end)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_text_has_parts_that_cover_it() {
        for text in [
            "",
            "<",
            "<a",
            "<a b",
            "<a b=",
            "<a b='",
            "<a b='x",
            "<a/",
            "</",
            "<!",
            "<!-",
            "<!--",
            "<!-->",
            "<?",
            "<![CDATA[",
            "<!DOCTYPE",
            "<!DOCTYPE a [",
            "a<b<c>",
            "<a =/>",
            "<\u{e4} \u{f6}:\u{fc}='1'/>",
            "<a b=c d>",
        ] {
            let mut whole = text;
            let mut count = 0;
            while !whole.is_empty() {
                let (_, length) = split_first_part(whole, 0);
                assert!(length > 0, "{text}");
                whole = &whole[length..];
                count += 1;
            }
            assert_eq!(xml_parts(text).count(), count, "{text}");
        }
    }

    #[test]
    fn quotes_hide_what_ends_a_tag() {
        let text = "<a b='/>' c = \"'<\" xs:d='1'>t</a>";
        let found: Vec<_> = xml_parts(text).collect();
        let XmlPart::Open(tag) = &found[0] else { panic!("{found:?}") };
        assert_eq!(
            (tag.name, tag.attributes.as_slice(), tag.is_empty),
            ("a", &["b", "c", "xs:d"][..], false)
        );
        assert_eq!(&text[tag.range.clone()], "<a b='/>' c = \"'<\" xs:d='1'>");
        assert!(matches!(found[1..], [XmlPart::Text(_), XmlPart::Close(_)]));
    }
}
