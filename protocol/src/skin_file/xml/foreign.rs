//! Detection of files whose content is of another kind than their name says.

/// The detected kind of a file, and a hint for the user.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct UnexpectedFileKind {
    /// Line of the file that shows the kind, from 1, if there is one.
    pub line: Option<usize>,
    /// The kind of the file, worded to follow "it is".
    pub what: &'static str,
    /// The hint for the user, in the imperative.
    pub hint: &'static str,
}

const CONFLICT_MARKER: &[u8] = b"<<<<<<< ";

/// Detects a file that is in the place of the expected one: a Git LFS pointer, a saved web page, an archive, or a file
/// with an unresolved merge conflict.
#[must_use]
pub fn detect_unexpected_file(bytes: &[u8]) -> Option<UnexpectedFileKind> {
    let whole = |what, hint| Some(UnexpectedFileKind { line: None, what, hint });
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes).trim_ascii_start();
    if text.starts_with(b"version https://git-lfs") {
        return whole("a Git LFS pointer to a file, not the file", "fetch it with `git lfs pull`");
    }
    let is = |begin: &[u8]| text.get(..begin.len()).is_some_and(|head| head.eq_ignore_ascii_case(begin));
    if is(b"<!doctype html") || is(b"<html") {
        return whole(
            "a web page (HTML), which a server may send if the address is wrong",
            "download the file itself",
        );
    }
    for (magic, what) in [
        (&b"PK\x03\x04"[..], "a zip archive"),
        (b"\x1f\x8b", "a gzip file"),
        (b"\x28\xb5\x2f\xfd", "a zstd file"),
    ] {
        if bytes.starts_with(magic) {
            return whole(what, "unpack it first");
        }
    }
    let conflict = bytes.split(|byte| *byte == b'\n').position(|line| line.starts_with(CONFLICT_MARKER))?;
    let hint = "keep one side, and delete the other side and the lines <<<<<<<, ======= and >>>>>>>";
    Some(UnexpectedFileKind { line: Some(conflict + 1), what: "a merge conflict of git", hint })
}

/// Returns the file format whose root element has this name.
#[must_use]
pub fn format_of_root_element(name: &str) -> Option<&'static str> {
    Some(match name {
        "sdf" | "gazebo" | "world" => "an SDF file of Gazebo",
        "mujoco" => "an MJCF file of MuJoCo",
        "robot" => "a robot's description (URDF or SRDF)",
        "COLLADA" => "a COLLADA mesh",
        "svg" => "an SVG drawing",
        "launch" => "a launch file of ROS",
        "package" => "a package.xml of ROS",
        "html" => "a web page (HTML)",
        "Error" => "an error message of a server",
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_that_stand_for_others_are_named() {
        let what = |bytes: &[u8]| {
            detect_unexpected_file(bytes).map(|it| (it.line, it.what.split(' ').nth(1).unwrap()))
        };
        assert_eq!(what(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"), Some((None, "Git")));
        assert_eq!(what(b"\n<!DOCTYPE html>\n<html>"), Some((None, "web")));
        assert_eq!(what(b"<HTML lang='en'>"), Some((None, "web")));
        assert_eq!(what(b"PK\x03\x04"), Some((None, "zip")));
        assert_eq!(what(b"<r>\n<<<<<<< HEAD\n=======\n>>>>>>> x\n</r>"), Some((Some(2), "merge")));
        for good in [&b""[..], b"<robot/>", b"solid a", b"<r>\n <<<<<<< HEAD</r>"] {
            assert_eq!(detect_unexpected_file(good), None);
        }
    }
}
