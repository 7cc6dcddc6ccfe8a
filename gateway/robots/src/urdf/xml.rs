//! Decoding of a file's bytes to XML text, and descriptions of XML errors.

use std::borrow::Cow;

use protocol::usage::printable;
use protocol::xml::{
    PreparedXml, UnexpectedFileKind, XmlFault, detect_unexpected_file, prepare, utf16_encoding_name,
};
use roxmltree::{Document, Error};

use crate::error::{RobotError, RobotProblem};

/// Decodes the bytes of a file: UTF-8, or Latin-1 or Windows-1252 if the file declares it. UTF-16 is rejected, because
/// the parser of ROS (urdfdom) rejects it too: a robot that is imported here also loads there.
///
/// # Errors
/// Returns [`RobotError`] if the file has another encoding, or is a placeholder for another file (a Git LFS pointer, a
/// saved web page).
pub fn decode_text<'a>(file: &str, bytes: &'a [u8]) -> Result<Cow<'a, str>, RobotError> {
    refuse_foreign_format(file, bytes)?;
    if let Some(name) = utf16_encoding_name(bytes) {
        let what = format!(
            "the file is UTF-16, which ROS cannot read either: save it as UTF-8, for example with \
             `iconv -f {name} -t utf-8 FILE > NEW`"
        );
        return Err(xml_error(file, XmlFault { line: None, what }));
    }
    protocol::xml::decode(bytes).map_err(|fault| xml_error(file, fault))
}

pub(super) fn prepare_text<'a>(file: &str, text: &'a str) -> Result<PreparedXml<'a>, RobotError> {
    refuse_foreign_format(file, text.as_bytes())?;
    let prepared = prepare(text).map_err(|fault| xml_error(file, fault))?;
    if prepared.text.is_empty() {
        return Err(RobotError::new(file, None, RobotProblem::Empty));
    }
    if !prepared.text.starts_with('<') {
        let line = u32::try_from(prepared.lines_before + 1).ok();
        return Err(RobotError::new(file, line, RobotProblem::NotXml));
    }
    Ok(prepared)
}

pub(super) fn parse_document<'a>(
    file: &str,
    prepared: &'a PreparedXml<'_>,
) -> Result<Document<'a>, RobotError> {
    Document::parse(&prepared.text).map_err(|reason| {
        let is_cut =
            matches!(reason, Error::UnclosedRootNode | Error::UnexpectedEndOfStream | Error::NoRootNode);
        let row = usize::try_from(reason.pos().row).unwrap_or_default();
        let row = if is_cut { prepared.text.lines().count() } else { row };
        xml_error(file, XmlFault { line: Some(prepared.lines_before + row), what: description(&reason) })
    })
}

fn refuse_foreign_format(file: &str, bytes: &[u8]) -> Result<(), RobotError> {
    let Some(UnexpectedFileKind { line, what, hint }) = detect_unexpected_file(bytes) else { return Ok(()) };
    let line = line.and_then(|line| u32::try_from(line).ok());
    Err(RobotError::new(file, line, RobotProblem::Xml(format!("this is {what}: {hint}"))))
}

fn xml_error(file: &str, XmlFault { line, what }: XmlFault) -> RobotError {
    let line = line.and_then(|line| u32::try_from(line).ok());
    RobotError::new(file, line, RobotProblem::Xml(what))
}

/// Describes an error of the XML parser, and the action that the user can take.
#[expect(clippy::wildcard_enum_match_arm, reason = "the parser's own words do for all others")]
fn description(reason: &Error) -> String {
    let plain = |what: &str| what.to_owned();
    match reason {
        Error::MalformedEntityReference(_) | Error::UnknownEntityReference(..) => {
            plain("the & does not begin an XML entity: write &amp; instead")
        }
        Error::UnexpectedDeclaration(_) => {
            plain("the XML declaration is not at the beginning of the file: delete it")
        }
        Error::UnexpectedCloseTag(expected, found, _) => {
            format!("</{found}> does not close the open <{expected}>: correct one of the two")
        }
        Error::UnclosedRootNode | Error::UnexpectedEndOfStream | Error::NoRootNode => {
            plain("the root element is not closed, so the file is incomplete: copy or download it again")
        }
        Error::DuplicatedAttribute(name, _) => {
            format!("an element has the attribute {name} twice: delete one")
        }
        Error::NonXmlChar(letter, _) => {
            format!("the character U+{:04X} cannot be in XML: delete it", u32::from(*letter))
        }
        Error::InvalidAttributeValue(_) => plain("an attribute value contains `<`: write `&lt;` instead"),
        Error::InvalidCharacterData(_) => plain("a text contains `]]>`: write `]]&gt;` instead"),
        Error::InvalidComment(_) => plain("a comment contains `--` or ends with `-`: delete the comment"),
        other => {
            let (text, place) = (other.to_string(), format!(" at {}", other.pos()));
            let text = text.strip_suffix(place.as_str()).unwrap_or(&text);
            format!("not XML: {}, in column {}: correct this line", printable(text), other.pos().col)
        }
    }
}
