//! Fuzz targets for files: captures, recordings, flash, descriptions, robots, meshes.

use std::io::{Cursor, Write as _};
use std::path::PathBuf;
use std::sync::LazyLock;

use analysis::report::run;
use cell_node::flash;
use cell_node::identity::Identity;
use cover::mesh::{Mesh, UpAxis};
use model::scenario::Scenario;
use protocol::candump::{self, CandumpLine};
use protocol::id::CellId;
use protocol::packet::crc16;
use protocol::skin::Skin;
use robots::{SkinImport, Urdf};
use tempfile::NamedTempFile;
use trace::capture::{CaptureFormat, Reader, RecordingItem};
use trace::recording::recover::recover as recover_into;

/// The skin that scenarios are read for.
static SKIN: LazyLock<Skin> =
    LazyLock::new(|| Skin::parse("skin.toml", include_str!("../../fuzz/seeds/skin/generated.toml")).unwrap());

/// Parses each line by itself: a frame must be written as a line with the same meaning.
pub(super) fn candump(data: &[u8]) {
    for line in data.split(|&byte| byte == b'\n') {
        let Ok(CandumpLine::Frame(record)) = candump::parse_bytes(line) else { continue };
        let mut text = String::new();
        candump::write_record(&mut text, &record).unwrap();
        let Ok(CandumpLine::Frame(again)) = candump::parse(&text) else { panic!("{text}") };
        assert_eq!(
            (again.time, again.interface, again.frame),
            (record.time, record.interface, record.frame),
            "{text}"
        );
    }
}

/// Reads a capture and returns its number of frames. A limit ends the reading of small files that unpack to large ones.
fn read(reader: &mut Reader) -> u64 {
    let mut frames = 0;
    for _ in 0..100_000 {
        match reader.next_item() {
            Ok(Some(RecordingItem::Entry(_))) => frames += 1,
            Ok(Some(RecordingItem::Other(_))) => {}
            Ok(None) | Err(_) => break,
        }
    }
    let _ = reader.extras().skin();
    frames
}

/// Reads a file of any kind, from a pipe and as a regular file: both must give the same frames. Only of a file is the
/// end known, by which a damaged recording is recognised; from a pipe it is text.
pub(super) fn capture(data: &[u8]) {
    let file = file_of(data);
    let [piped, opened] =
        [Reader::from_read("data", Cursor::new(data.to_owned())), Reader::open(file.path())]
            .map(|reader| reader.map(|mut reader| (reader.format(), read(&mut reader))).ok());
    if let (Some((CaptureFormat::Candump, _)), Some((CaptureFormat::Mcap, _))) = (piped, opened) {
        return assert!(!data.starts_with(mcap::MAGIC), "a pipe shows its beginning");
    }
    let frames = |read: Option<(CaptureFormat, u64)>| read.map_or(0, |(_, frames)| frames);
    assert_eq!(frames(piped), frames(opened));
}

fn file_of(data: &[u8]) -> NamedTempFile {
    let mut file = NamedTempFile::new().unwrap();
    file.write_all(data).unwrap();
    file
}

/// Recovers a recording: the result must be a complete file that can be read without an error and has the counted
/// number of messages.
pub(super) fn recover(data: &[u8]) {
    let mut out = Vec::new();
    let Ok(recovered) = recover_into(Cursor::new(data), &mut out) else { return };
    let again = recover_into(Cursor::new(&out), std::io::sink()).unwrap();
    assert_eq!(again.messages, recovered.messages);
    let mut reader = Reader::from_read("recovered", Cursor::new(out)).unwrap();
    while reader.next_item().is_ok_and(|item| item.is_some()) {}
}

/// Makes a report of a recording with any damage: the result must be a report, or an error in one line.
pub(super) fn report(data: &[u8]) {
    let file = file_of(data);
    let report = run::report(&[PathBuf::from(file.path())], &run::ReportOptions::default());
    if let Err(error) = report {
        assert!(!error.to_string().contains('\n'), "{error}");
    }
}

/// Decodes a flash image with a correct CRC: it must be refused, or encoded as the same image again.
pub(super) fn flash(data: &[u8]) {
    let identity = Identity { cell: CellId::new(12).ok(), serial: 0x0102_0304 };
    let _ = flash::decode(identity, data);
    let crc = crc16(data).to_le_bytes();
    let whole = [data, &crc].concat();
    let Ok(kept) = flash::decode(identity, &whole) else { return };
    let bytes = flash::encode(identity.serial, &kept);
    assert_eq!(flash::decode(identity, &bytes), Ok(kept));
}

/// Parses a skin: if it is accepted, the parameters of its cells must be valid; otherwise the error must have one line.
pub(super) fn skin(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    let skin = match Skin::parse("skin.toml", text) {
        Ok(skin) => skin,
        Err(error) => return assert!(!error.to_string().contains('\n'), "{error}"),
    };
    for cell in &skin.cells {
        let parameters = skin.parameters(cell);
        assert_eq!(parameters.check(), Ok(()), "{cell:?}");
    }
}

/// Parses a scenario: if it is accepted, evaluating it must not panic; otherwise the error must have one line.
pub(super) fn scenario(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    match Scenario::parse("scenario.toml", text, &SKIN) {
        Ok(scenario) => {
            let _ = scenario.mode_at(protocol::time::Micros(0));
        }
        Err(error) => assert!(!error.to_string().contains('\n'), "{error}"),
    }
}

/// Parses a robot: if its chains are accepted, the skin written from it must be accepted too.
pub(super) fn urdf(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    let Ok(urdf) = Urdf::parse("robot.urdf", text) else { return };
    let leaves: Vec<_> = urdf.leaves().take(4).map(str::to_owned).collect();
    for tip in leaves {
        let Ok(chain) = urdf.chain(None, &tip) else { continue };
        let import =
            SkinImport { name: "robot", command: "import", urdf: None, chains: &[chain], cells: &[] };
        let Ok(skin) = import.toml() else { continue };
        Skin::parse("skin.toml", &skin).unwrap_or_else(|error| panic!("{error}: {skin}"));
    }
}

/// Reads a mesh of any kind, selected by the first byte.
pub(super) fn mesh(data: &[u8]) {
    let Some((kind, bytes)) = data.split_first() else { return };
    let name = ["mesh.stl", "mesh.dae", "mesh.obj"].get(usize::from(kind % 3)).copied().unwrap_or_default();
    if let Ok(mesh) = Mesh::parse(name, bytes, UpAxis::Follow) {
        let finite =
            |triangle: &cover::mesh::Triangle| triangle.iter().flat_map(|p| p.iter()).all(|v| v.is_finite());
        assert!(!mesh.triangles().is_empty() && mesh.triangles().iter().all(finite));
    }
}
