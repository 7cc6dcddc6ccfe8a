//! Tests that edits keep all other bytes of a text, and that new texts can be parsed.

use super::*;
use crate::can::Format;
use crate::skin::Skin;

/// A text with the irregularities of hand-written files: comments, odd spaces, multi-line arrays, quoted
/// keys, and no final line ending.
const HAND: &str = r#"# of a hand
version=1
robot = { name = "odd \u00e9",   joints = [{ d = 0.1, alpha = 1.5707963267948966 },
  { a = 5e-1 }   # the second
] }

	# indented by a tab
[[cell]]   # first
  node   =   1 # one
  'joint' = 2
  position = [ -0.2,
    0.0, # y
    +0.06,
  ]
  normal = [0, 1.0, 0]# up
  neighbors = [ 2 , 0, 0, 0 ]

[[ cell ]]
"node" = 2
joint = 0x1
position = [0.0, 0.0, 0.06]
neighbors = [1, 0, 0, 0]
orientation = [0.0, 0.0, 0.0, 1.0]"#;

/// The cells of [`HAND`] as inline tables in an array.
const INLINE: &str = r#"cell = [
  { node = 1, joint = 2, position = [-0.2, 0.0, 0.06], normal = [0.0, 1.0, 0.0], neighbors = [2, 0, 0, 0] }, # one
  {node=2,joint=1,position=[0.0,0.0,0.06],orientation=[0.0,0.0,0.0,1.0],neighbors=[1,0,0,0]},
]
[robot]
joints = [{ d = 0.1, alpha = 1.5707963267948966 }, { a = 0.5 }]
"#;

fn parsed(text: &str) -> Skin {
    Skin::parse("skin.toml", text).unwrap()
}

/// Returns the text in four variants: unchanged, with CRLF, with mixed line endings, and with a byte order mark.
fn forms(text: &str) -> [String; 4] {
    let dos = text.replace('\n', "\r\n");
    let mixed = text.replacen('\n', "\r\n", 3);
    [text.to_owned(), dos, mixed, format!("\u{feff}{text}")]
}

#[test]
fn a_text_without_changes_is_the_given_one() {
    let example = concat!(env!("CARGO_MANIFEST_DIR"), "/../gateway/examples/ur5-253.toml");
    let example = std::fs::read_to_string(example).unwrap();
    for text in [HAND, INLINE, &example].into_iter().flat_map(forms) {
        let skin = parsed(&text);
        assert_eq!(SkinEdit::new(&skin, &text).unwrap().edited_text(), text);
    }
}

#[test]
fn values_change_and_no_other_byte() {
    for text in forms(HAND) {
        let mut edit = SkinEdit::new(&parsed(&text), &text).unwrap();
        edit.set(0, "node", Value::Integer(50));
        edit.set(0, "joint", Value::Integer(1));
        edit.set(0, "position", Value::Numbers(&[0.5, -0.25, 1.0]));
        edit.replace_key(0, "normal", "orientation", Value::Numbers(&[0.0, 0.0, 0.6, 0.8]));
        edit.set(1, "node", Value::Integer(7));
        edit.set_element(0, "neighbors", 0, Value::Integer(7));
        edit.set(1, "row", Value::Integer(9));
        let array = text.get(text.find("[ -0.2").unwrap()..text.find("normal").unwrap()).unwrap();
        let array = array.trim_end();
        let expected = text
            .replace("node   =   1 #", "node   =   50 #")
            .replace("'joint' = 2", "'joint' = 1")
            .replace(array, "[0.5, -0.25, 1.0]")
            .replace("normal = [0, 1.0, 0]#", "orientation = [0.0, 0.0, 0.6, 0.8]#")
            .replace("[ 2 , 0,", "[ 7 , 0,")
            .replace("\"node\" = 2", "\"node\" = 7");
        assert_eq!(edit.edited_text(), expected);
    }
}

#[test]
fn a_new_key_has_a_line_of_its_own() {
    for (text, end) in forms(HAND).iter().zip(["\n", "\r\n", "\n", "\n"]) {
        let mut edit = SkinEdit::new(&parsed(text), text).unwrap();
        edit.insert_key_after(0, "serial", Value::Integer(12), "node");
        edit.insert_key_after(1, "root", Value::Flag(true), "orientation");
        edit.insert_key_after(1, "serial", Value::Integer(13), "nothing");
        let expected = text.replace("1 # one", &format!("1 # one{end}  serial = 12")) + end + "root = true";
        // The last line has no line ending to copy.
        let expected = expected.replace("\r\nroot = true", "\nroot = true");
        let new = edit.edited_text();
        assert_eq!(new, expected);
        let new = parsed(&new);
        assert_eq!((new.cells[0].serial, new.cells[1].root), (12, true));
    }
}

#[test]
fn cells_in_an_array_are_edited_in_their_places() {
    let mut edit = SkinEdit::new(&parsed(INLINE), INLINE).unwrap();
    edit.set(0, "node", Value::Integer(3));
    edit.insert_key_after(0, "serial", Value::Integer(1), "node");
    edit.set_element(1, "neighbors", 0, Value::Integer(3));
    edit.replace_key(0, "normal", "orientation", Value::Numbers(&[0.0, 0.0, 0.0, 1.0]));
    let expected = INLINE
        .replace("{ node = 1,", "{ node = 3, serial = 1,")
        .replace("neighbors=[1,", "neighbors=[3,")
        .replace("normal = [0.0, 1.0, 0.0]", "orientation = [0.0, 0.0, 0.0, 1.0]");
    let new = edit.edited_text();
    assert_eq!(new, expected);
    assert_eq!(parsed(&new).cells[0].serial, 1);
}

#[test]
fn a_text_of_another_skin_is_refused() {
    let skin = parsed(HAND);
    let said = |text: &str| SkinEdit::new(&skin, text).unwrap_err().to_string();
    assert_eq!(said("[[cell]]\nnode = 1\n"), "it has 1 cells, not 2");
    assert_eq!(said("cell = 1\n"), "write its cells as [[cell]] tables");
    assert_eq!(said("version = 1\n"), "write its cells as [[cell]] tables");
    assert!(said("[[cell]\n").contains("TOML parse error"));
}

#[test]
fn texts_of_any_letters_are_read_back() {
    for name in [
        "arm",
        "a\"b\\c",
        "e\u{301}",
        "Größe 'x'",
        "tab\there",
        "\u{1b}[0m\u{7f}\u{202e}",
        "\u{10ffff}\u{1f916}",
    ] {
        let text = format!("name = {}", Value::Text(name));
        let read: toml::Table = text.parse().unwrap();
        assert_eq!(read["name"].as_str(), Some(name), "{text}");
    }
    for number in [0.0, -0.0, 1.0, 1e-7, -2.5e300, f64::MIN_POSITIVE, 0.1 + 0.2] {
        let text = format!("x = [{}, {}]", Value::Number(number), Value::Numbers(&[number]));
        let read: toml::Table = text.parse().unwrap();
        assert_eq!(read["x"][0].as_float().map(f64::to_bits), Some(number.to_bits()), "{text}");
        assert_eq!(read["x"][1][0].as_float().map(f64::to_bits), Some(number.to_bits()), "{text}");
    }
}

#[test]
fn a_draft_is_a_skin() {
    let mut draft = SkinDraft::default();
    draft.add_comment("made\nby a test");
    draft.add_comment("");
    draft.add_table_header("[robot]", Some("of one joint"));
    draft.set_table_rows("joints", None, [vec![("d", Value::Number(0.1))]].into_iter());
    draft.add_paper_settings(50.0);
    draft.add_bus(&DraftBus { name: "can0", chain: None, slot_us: Some(900), format: Format::Classic });
    draft.add_cell(&DraftCell {
        remark: Some("on a link"),
        bus: "can0",
        node: 3,
        serial: Some(33),
        joint: 1,
        row: None,
        position: [0.0, 0.1, 0.2],
        facing: CellFacing::Normal([0.0, 0.0, 1.0]),
        neighbors: Some([0; 4]),
        root: true,
    });
    let text = draft.into_text();
    assert!(text.starts_with("# made\\u{a}by a test\n#\n\n[robot]   # of one joint\n"), "{text}");
    let skin = parsed(&text);
    assert_eq!((skin.cells[0].serial, skin.cells[0].root, skin.buses[0].name.as_str()), (33, true, "can0"));
}
