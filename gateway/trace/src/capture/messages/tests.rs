use super::*;
use std::path::Path;

fn recordings(names: &[&str]) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/recordings");
    names.iter().map(|name| folder.join(name)).collect()
}

/// A message: topic, type, log time and contents.
type Read = (String, String, u64, Vec<u8>);

/// Returns all messages of files as the crate `mcap` reads them.
fn read_by_mcap(paths: &[PathBuf]) -> Vec<Read> {
    let messages = paths.iter().flat_map(|path| {
        let bytes = std::fs::read(path).unwrap();
        let messages = ::mcap::MessageStream::new(&bytes).unwrap();
        let messages = messages.map(|message| {
            let message = message.unwrap();
            let schema = message.channel.schema.as_ref().unwrap().name.clone();
            (message.channel.topic.clone(), schema, message.log_time, message.data.to_vec())
        });
        messages.collect::<Vec<_>>()
    });
    messages.collect()
}

fn read_until(reader: &mut MessageReader, until: u64) -> Vec<Read> {
    let mut all = Vec::new();
    while let Some(RecordedMessage { channel, log_nanos, message }) = reader.next_until(until).unwrap() {
        let message = message.to_vec();
        let ChannelDescription { topic, schema_name, .. } = reader.channels()[channel].clone();
        all.push((topic, schema_name, log_nanos, message));
    }
    all
}

#[test]
fn all_messages_are_those_that_another_reader_finds() {
    for (given, ordered) in [
        (&["fd.mcap"][..], &["fd.mcap"][..]),
        (&["two.mcap"], &["two.mcap"]),
        (&["split-2.mcap", "split.mcap", "split-1.mcap"], &["split.mcap", "split-1.mcap", "split-2.mcap"]),
    ] {
        let expected = read_by_mcap(&recordings(ordered));
        let mut reader = MessageReader::open(&recordings(given)).unwrap();
        assert!(expected.len() > 1_000 && reader.channels().len() > 5, "{given:?}");
        assert!(read_until(&mut reader, u64::MAX) == expected, "{given:?}");
        assert_eq!(reader.next_until(u64::MAX).unwrap(), None);
        for channel in reader.channels() {
            assert_eq!((channel.encoding.as_str(), channel.schema_encoding.as_str()), ("cdr", "ros2msg"));
            let is_latched = ["/tf_static", "/robot_description"].contains(&channel.topic.as_str());
            assert_eq!(channel.is_latched, is_latched, "{}", channel.topic);
        }
    }
}

#[test]
fn reading_goes_on_at_any_time_forwards_and_backwards() {
    let ordered = recordings(&["split.mcap", "split-1.mcap", "split-2.mcap"]);
    let all = read_by_mcap(&ordered);
    let mut reader = MessageReader::open(&ordered).unwrap();
    for share in [90, 10, 50, 0, 99, 35] {
        let first = all[all.len() * share / 100].2;
        let until = first + 300_000_000;
        reader.seek(first).unwrap();
        // In the order of the file, in which a message may be a little earlier than the one before it.
        let expected: Vec<_> =
            all.iter().skip_while(|it| it.2 < first).take_while(|it| it.2 <= until).cloned().collect();
        assert!(read_until(&mut reader, until) == expected, "from {share} %");
    }
    reader.seek(u64::MAX).unwrap();
    assert_eq!(reader.next_until(u64::MAX).unwrap(), None);
}

#[test]
fn damage_ends_reading_with_an_error_that_names_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("damaged.mcap");
    let mut bytes = std::fs::read(&recordings(&["fd.mcap"])[0]).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle..middle + 64].fill(0xA5);
    std::fs::write(&path, bytes).unwrap();
    let mut reader = MessageReader::open(&[path]).unwrap();
    let failed = loop {
        match reader.next_until(u64::MAX) {
            Ok(Some(_)) => {}
            Ok(None) => panic!("the damage was not found"),
            Err(error) => break error.to_string(),
        }
    };
    assert!(failed.contains("damaged.mcap"), "{failed}");
    assert_eq!(reader.next_until(u64::MAX).unwrap(), None);
}
