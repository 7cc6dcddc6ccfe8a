//! Character encodings of XML files.

use std::borrow::Cow;

use super::{XmlFault, line_of};

/// The characters that the bytes 0x80 to 0x9F stand for in Windows-1252.
const WINDOWS_1252: [char; 32] = [
    '\u{20ac}', '\u{81}', '\u{201a}', '\u{192}', '\u{201e}', '\u{2026}', '\u{2020}', '\u{2021}', '\u{2c6}',
    '\u{2030}', '\u{160}', '\u{2039}', '\u{152}', '\u{8d}', '\u{17d}', '\u{8f}', '\u{90}', '\u{2018}',
    '\u{2019}', '\u{201c}', '\u{201d}', '\u{2022}', '\u{2013}', '\u{2014}', '\u{2dc}', '\u{2122}', '\u{161}',
    '\u{203a}', '\u{153}', '\u{9d}', '\u{17e}', '\u{178}',
];

/// Decodes a file to text. The file may be in UTF-8, in UTF-16 with a byte order mark or a declaration, or in Latin-1
/// or Windows-1252 with a declaration. Valid UTF-8 is read as UTF-8, whatever its declaration. In a text that was
/// converted, the declaration is changed to UTF-8.
///
/// # Errors
/// Returns an error for any other encoding.
pub fn decode(bytes: &[u8]) -> Result<Cow<'_, str>, XmlFault> {
    let wide = |bytes: &[u8], read: fn([u8; 2]) -> u16| {
        let words: Vec<_> = bytes.as_chunks().0.iter().map(|word| read(*word)).collect();
        let text = String::from_utf16(&words).ok().filter(|_| bytes.len().is_multiple_of(2));
        let wrong =
            || "it begins like UTF-16 but is invalid: it is truncated or damaged; copy or download it again";
        text.map(|text| Cow::Owned(declare_utf8(text)))
            .ok_or_else(|| XmlFault { line: None, what: wrong().to_owned() })
    };
    match bytes {
        [0xff, 0xfe, rest @ ..] => return wide(rest, u16::from_le_bytes),
        [0xfe, 0xff, rest @ ..] => return wide(rest, u16::from_be_bytes),
        [b'<', 0, b'?', 0, ..] => return wide(bytes, u16::from_le_bytes),
        [0, b'<', 0, b'?', ..] => return wide(bytes, u16::from_be_bytes),
        _ => {}
    }
    let error = match core::str::from_utf8(bytes) {
        Ok(text) => return Ok(Cow::Borrowed(text)),
        Err(error) => error,
    };
    let declared = declared_encoding(bytes);
    let single = |c1: fn(u8) -> char| {
        let letter = |byte: &u8| if (0x80..0xa0).contains(byte) { c1(*byte) } else { char::from(*byte) };
        Ok(Cow::Owned(declare_utf8(bytes.iter().map(letter).collect())))
    };
    match declared.as_deref().unwrap_or_default() {
        "iso-8859-1" | "iso8859-1" | "iso_8859-1" | "latin1" | "latin-1" => single(char::from),
        "windows-1252" | "cp1252" => single(|byte| {
            WINDOWS_1252.get(usize::from(byte) - 0x80).copied().unwrap_or(char::REPLACEMENT_CHARACTER)
        }),
        other => {
            let line = line_of(bytes, error.valid_up_to());
            let from = if matches!(other, "" | "utf-8" | "utf8" | "us-ascii") { "latin1" } else { other };
            let declared = if other.is_empty() { String::new() } else { format!(", declared as {other}") };
            let what = format!(
                "it is not UTF-8{declared}: save it as UTF-8, for example with `iconv -f {from} -t utf-8 \
                 FILE > NEW` (if it is in Latin-1)"
            );
            let what = if from == "latin1" { what } else { what.replace(" (if it is in Latin-1)", "") };
            Err(XmlFault { line: Some(line), what })
        }
    }
}

/// Returns the name that `iconv` uses for the encoding of a file in UTF-16; `None` for other encodings.
#[must_use]
pub fn utf16_encoding_name(bytes: &[u8]) -> Option<&'static str> {
    match bytes {
        [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => Some("utf-16"),
        [b'<', 0, b'?', 0, ..] => Some("utf-16le"),
        [0, b'<', 0, b'?', ..] => Some("utf-16be"),
        _ => None,
    }
}

/// Returns the encoding in the XML declaration, in lower case.
fn declared_encoding(bytes: &[u8]) -> Option<String> {
    let head = bytes.get(..bytes.len().min(1024)).unwrap_or_default();
    let head = String::from_utf8_lossy(head);
    let (begin, end) = encoding_range(&head)?;
    let name = head.get(begin..end)?;
    name.bytes().all(|byte| byte.is_ascii_graphic()).then(|| name.to_ascii_lowercase())
}

/// Returns the byte range of the encoding's name in the XML declaration.
fn encoding_range(text: &str) -> Option<(usize, usize)> {
    let begin = text.find("<?xml")?;
    let declaration = text.get(begin..begin + text.get(begin..)?.find("?>")?)?;
    let after = begin + declaration.find("encoding")? + "encoding".len();
    let quote = after + text.get(after..)?.find(['"', '\''])?;
    let (name, sign) = (quote + 1, text.get(quote..=quote)?);
    Some((name, name + text.get(name..)?.find(sign)?))
}

fn declare_utf8(mut text: String) -> String {
    if let Some((begin, end)) = encoding_range(&text) {
        text.replace_range(begin..end, "UTF-8");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    const WORDS: &str = "<?xml version='1.0' encoding=\"ENC\"?>\n<r n='M\u{fc}ller'/>";

    fn single(encoding: &str) -> Vec<u8> {
        let text = WORDS.replace("ENC", encoding);
        text.chars().map(|letter| u8::try_from(u32::from(letter)).unwrap()).collect()
    }

    #[test]
    fn a_declared_encoding_is_read() {
        let expected = WORDS.replace("ENC", "UTF-8");
        for name in ["ISO-8859-1", "latin1", "windows-1252"] {
            assert_eq!(decode(&single(name)).unwrap(), expected, "{name}");
        }
        let dash = decode(b"<?xml version='1.0' encoding='cp1252'?><r n='\x96\xfc'/>").unwrap().into_owned();
        assert!(dash.contains("n='\u{2013}\u{fc}'"), "{dash}");
        let wide = WORDS.replace("ENC", "UTF-16");
        for (mark, names) in [("", ["utf-16le", "utf-16be"]), ("\u{feff}", ["utf-16"; 2])] {
            let words: Vec<_> = format!("{mark}{wide}").encode_utf16().collect();
            let little: Vec<_> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
            let big: Vec<_> = words.iter().flat_map(|word| word.to_be_bytes()).collect();
            assert_eq!(decode(&little).unwrap(), expected);
            assert_eq!(decode(&big).unwrap(), expected);
            assert_eq!([&little, &big].map(|bytes| utf16_encoding_name(bytes).unwrap()), names);
        }
        // Valid UTF-8 is not read as Latin-1, whatever the declaration.
        let both = WORDS.replace("ENC", "latin1");
        assert_eq!(utf16_encoding_name(both.as_bytes()), None);
        assert_eq!(decode(both.as_bytes()).unwrap(), both);
    }

    #[test]
    fn other_encodings_are_refused_with_the_line_and_a_command() {
        let refused = |bytes: &[u8]| decode(bytes).unwrap_err().to_string();
        assert_eq!(
            refused(b"<r>\n<!-- \xfc --></r>"),
            "line 2: it is not UTF-8: save it as UTF-8, for example with `iconv -f latin1 -t utf-8 FILE > \
             NEW` (if it is in Latin-1)"
        );
        assert_eq!(
            refused(b"<?xml version='1.0' encoding='GBK'?>\n<r n='\xc4\xe3'/>"),
            "line 2: it is not UTF-8, declared as gbk: save it as UTF-8, for example with `iconv -f gbk -t utf-8 FILE > NEW`"
        );
        assert!(refused(b"\xff\xfe<\0r\0/\0>").contains("truncated"));
    }
}
