use super::*;
use crate::capture::log::{LogStyle, TimeDigits};
use crate::capture::{CaptureEntry, CaptureFormat, convert::CaptureWriter};
use protocol::can::Frame;
use protocol::candump::{Record, Timestamp};
use std::os::fd::AsRawFd;

const COUNT: u32 = 20_000;
const MS: u64 = 1_000_000;

/// Writes a capture of two buses whose frames are read in turn, up to 0.3 s late.
fn capture(path: &Path, format: CaptureFormat) {
    let style = LogStyle { digits: TimeDigits::Nine, ..LogStyle::default() };
    let mut out = CaptureWriter::new(File::create(path).unwrap(), format, style).unwrap();
    for number in 0..COUNT {
        let burst = u64::from(number / 300);
        let (interface, nanos) = match number % 300 {
            first @ 0..150 => ("can0", burst * 300 * MS + u64::from(first) * 2 * MS),
            second => ("can1", burst * 300 * MS + u64::from(second - 150) * 2 * MS + MS),
        };
        let frame = Frame::classic(0x123, &number.to_be_bytes()).unwrap();
        let time = Timestamp::with_nine_digits(1_700_000_000_000_000_000 + nanos);
        out.write(&CaptureEntry::Frame(Record { time, interface, frame, direction: None })).unwrap();
    }
    out.finish().unwrap();
}

/// Returns the number and the time of each of the next `count` frames.
fn next(reader: &mut Reader, count: usize) -> Vec<(u32, u64)> {
    let mut all = Vec::new();
    while let Some(entry) = reader.next().unwrap() {
        let CaptureEntry::Frame(record) = entry else { continue };
        all.push((u32::from_be_bytes(record.frame.data().try_into().unwrap()), record.time.nanos));
        if all.len() == count {
            break;
        }
    }
    all
}

#[test]
fn a_reader_goes_on_where_it_was_and_no_moment_is_before_its_place() {
    let folder = tempfile::tempdir().unwrap();
    for format in [CaptureFormat::Candump, CaptureFormat::Mcap] {
        let path = folder.path().join(format!("{format:?}"));
        capture(&path, format);
        let paths = [path];
        let places = SeekIndex::open(&paths).unwrap();
        assert!(places.marks.len() > 3, "{format:?}: {}", places.marks.len());
        let mut reader = Reader::open_all(&paths).unwrap();
        let (mut here, mut all) = (Vec::new(), Vec::new());
        loop {
            here.push(reader.seek_point());
            let Some(&one) = next(&mut reader, 1).first() else { break };
            all.push(one);
        }
        assert_eq!(all.len(), COUNT as usize);
        assert!(places.latest_ns() >= all.last().unwrap().1, "{format:?}");
        for from in (0..all.len()).step_by(997) {
            reader.seek(&places, here[from]).unwrap();
            let count = 900.min(all.len() - from);
            assert_eq!(next(&mut reader, count), all[from..from + count], "{format:?} {from}");
        }
        reader.seek(&places, here[COUNT as usize]).unwrap();
        assert_eq!(next(&mut reader, 1), []);
        for at in (0..all.len()).step_by(311) {
            let nanos = all[at].1;
            reader.seek(&places, places.point_before(nanos)).unwrap();
            let (first, _) = next(&mut reader, 1)[0];
            let earliest = all.iter().position(|(_, time)| *time >= nanos).unwrap();
            assert!(first as usize <= earliest, "{format:?}: {first} {earliest}");
            assert!(earliest - (first as usize) < 6_000, "{format:?}: {first} {earliest}");
        }
    }
}

#[test]
fn in_console_text_whose_times_depend_on_other_lines_a_reader_goes_on_too() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("console.txt");
    for stamp in ["none", "difference"] {
        let line = |number: u32| {
            let [.., a, b] = number.to_be_bytes();
            let time = format!("(000.{:06})", if number.is_multiple_of(2) { 2_000 } else { 1_000 });
            let time = if stamp == "none" { "" } else { &time };
            format!("  {time}  can0  123   [4]  00 00 {a:02X} {b:02X}\n")
        };
        std::fs::write(&path, (0..9_000).map(line).collect::<String>()).unwrap();
        let paths = [path.clone()];
        let places = SeekIndex::open(&paths).unwrap();
        assert!(places.marks.len() > 3, "{}", places.marks.len());
        let mut reader = Reader::open_all(&paths).unwrap();
        let all = next(&mut reader, 9_000);
        let (_, end) = all[8_999];
        assert_eq!(end, if stamp == "none" { 8_999_000 } else { 13_500 * MS }, "{stamp}");
        assert_eq!(places.latest_ns(), end);
        for from in (0..all.len()).step_by(997) {
            reader.seek(&places, places.point_before(all[from].1)).unwrap();
            let (first, _) = next(&mut reader, 1)[0];
            assert!(first as usize <= from && from < first as usize + 3_000, "{stamp}: {first} {from}");
            let count = (from - first as usize).min(all.len() - 1);
            let next = next(&mut reader, count + 1);
            assert_eq!(next, all[first as usize + 1..][..next.len()], "{stamp} {from}");
        }
    }
}

#[test]
fn messages_outside_chunks_and_files_without_an_end_have_places() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("loose.mcap");
    let mut writer =
        ::mcap::WriteOptions::new().use_chunks(false).create(File::create(&path).unwrap()).unwrap();
    let schema = writer.add_schema("can_msgs/msg/Frame", "ros2msg", b"").unwrap();
    let channel = writer.add_channel(schema, "/can0", "cdr", &Default::default()).unwrap();
    for number in 0..3_000_u64 {
        let header = ::mcap::records::MessageHeader {
            channel_id: channel,
            sequence: 0,
            log_time: number,
            publish_time: number,
        };
        writer.write_to_known_channel(&header, &[0; 40]).unwrap();
    }
    drop(writer);
    let whole = SeekIndex::open_with_min_distance(std::slice::from_ref(&path), 1_000).unwrap();
    assert!(whole.marks.len() > 100 && whole.latest_ns() == 2_999);
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let cut = SeekIndex::open_with_min_distance(&[path], 1_000).unwrap();
    assert!(cut.marks.len() > 40 && (1_000..2_000).contains(&cut.latest_ns()), "{}", cut.latest_ns());
}

#[test]
fn what_cannot_be_gone_back_in_is_named() {
    let (reader, _writer) = io::pipe().unwrap();
    let pipe = format!("/dev/fd/{}", reader.as_raw_fd());
    let error = SeekIndex::open(&[PathBuf::from(&pipe)]).unwrap_err().to_string();
    assert!(error.starts_with(&format!("{pipe}: it is a stream")), "{error}");
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in
        [("empty", &b""[..]), ("text", b"nothing\n"), ("head", MAGIC), ("cut", b"\x89MCAP0\r\n\x06\xFF")]
    {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        let places = SeekIndex::open(&[path]).unwrap();
        assert_eq!((places.latest_ns(), places.point_before(5).offset), (0, 0), "{name}");
    }
}
