//! Command-line conventions: errors of one line with an exit code, output to a reader that may close the pipe, text
//! that is safe to show on a terminal, and words quoted for a shell.

use std::borrow::Cow;
use std::ffi::OsStr;
use std::fmt::{self, Display, Write as _};
use std::io::{self, ErrorKind, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use crate::stop::InterruptibleWriter;

/// An error message with its exit code.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Failure {
    text: String,
    code: u8,
}

impl Failure {
    /// Creates an error for wrong usage or an invalid configuration, with exit code 2.
    #[must_use]
    pub fn usage_error(text: impl Display) -> Self {
        Self::with_code(2, text)
    }

    /// Creates an error for an operation that failed, with exit code 1.
    #[must_use]
    pub fn run_error(text: impl Display) -> Self {
        Self::with_code(1, text)
    }

    /// Creates an error without a message, with exit code 1, for a failure that the program has already reported in its
    /// output.
    #[must_use]
    pub const fn already_reported() -> Self {
        Self { text: String::new(), code: 1 }
    }

    /// Creates an error with an exit code.
    #[must_use]
    pub fn with_code(code: u8, text: impl Display) -> Self {
        Self { text: text.to_string(), code }
    }

    /// Returns the exit code.
    #[must_use]
    pub const fn code(&self) -> u8 {
        self.code
    }

    /// Appends the text of a further error to the message.
    #[must_use]
    pub fn append(mut self, more: impl Display) -> Self {
        self.text += &format!("; and {more}");
        self
    }
}

impl Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

/// Prints the error, if any, prefixed with the program's name, to standard error in one write. Returns the exit code of
/// the program.
#[must_use]
pub fn exit_code(program: &str, done: Result<(), Failure>) -> ExitCode {
    let Err(Failure { text, code }) = done else { return ExitCode::SUCCESS };
    if !text.is_empty() {
        eprint_line(&format!("{program}: {text}"));
    }
    ExitCode::from(code)
}

/// Writes a line to standard error in one write, made printable by [`printable`]. Errors are ignored.
pub fn eprint_line(line: &str) {
    let _ = InterruptibleWriter::new(io::stderr()).write_all(format!("{}\n", printable(line)).as_bytes());
}

/// Writes text of several lines to standard error in one write, made printable by [`printable_lines`]. Errors are
/// ignored.
pub fn eprint_lines(text: &str) {
    let _ = InterruptibleWriter::new(io::stderr()).write_all(printable_lines(text).as_bytes());
}

/// Writes text to standard output. On a terminal, [`printable_lines`] makes the text printable first.
///
/// # Errors
/// Returns the errors of [`ignore_broken_pipe`].
pub fn print_text(text: &str) -> Result<(), Failure> {
    if io::stdout().is_terminal() { print_raw(&printable_lines(text)) } else { print_raw(text) }
}

/// Writes text to standard output unchanged, including terminal control sequences.
///
/// # Errors
/// Returns the errors of [`ignore_broken_pipe`].
pub fn print_raw(text: &str) -> Result<(), Failure> {
    ignore_broken_pipe(write_stdout(text))
}

/// Writes text to standard output unchanged, for callers that must notice when the reader closes the pipe.
///
/// # Errors
/// Returns an error if the text cannot be written, including when the reader has closed the pipe.
pub fn write_stdout(text: &str) -> io::Result<()> {
    InterruptibleWriter::new(io::stdout()).write_all(text.as_bytes())
}

/// Makes a name or line printable: control characters and marks of text direction become escapes like
/// `\u{1b}`.
#[must_use]
pub fn printable(text: &str) -> Cow<'_, str> {
    escape_chars(text, is_unprintable)
}

/// Makes a text of several lines printable, like [`printable`], but keeps line feeds and tabs.
#[must_use]
pub fn printable_lines(text: &str) -> Cow<'_, str> {
    escape_chars(text, |letter| is_unprintable(letter) && !matches!(letter, '\n' | '\t'))
}

/// Returns true for control characters, marks and overrides of text direction, line separators, invisible
/// characters that make two names look alike, and code points that are not characters (Unicode 16, 23.7 and
/// 23.8).
#[must_use]
pub const fn is_unprintable(letter: char) -> bool {
    matches!(
        letter,
        '\0'..='\u{1f}'
            | '\u{7f}'..='\u{9f}'
            | '\u{ad}'
            | '\u{61c}'
            | '\u{200b}'
            | '\u{200e}'..='\u{200f}'
            | '\u{2028}'..='\u{202e}'
            | '\u{2060}'..='\u{206f}'
            | '\u{fdd0}'..='\u{fdef}'
            | '\u{feff}'
            | '\u{fff0}'..='\u{fffb}'
    ) || letter as u32 & 0xfffe == 0xfffe
}

/// Replaces the characters that `is_coded` selects with escapes like `\u{1b}`.
fn escape_chars(text: &str, is_coded: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&is_coded) {
        return Cow::Borrowed(text);
    }
    let mut whole = String::with_capacity(text.len() + 16);
    for letter in text.chars() {
        if is_coded(letter) {
            whole.extend(letter.escape_unicode());
        } else {
            whole.push(letter);
        }
    }
    Cow::Owned(whole)
}

/// Converts the result of a write to standard output. A pipe closed by its reader, as `head` does, is not an error.
///
/// # Errors
/// Returns an error if the write failed for another reason.
pub fn ignore_broken_pipe(done: io::Result<()>) -> Result<(), Failure> {
    match done {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::run_error(format!("standard output: {error}")))
        }
        Ok(()) | Err(_) => Ok(()),
    }
}

/// Flushes standard output after another library has printed to it, such as requested help.
///
/// # Errors
/// Returns a failure if printing or flushing failed, unless the reader has closed the pipe.
pub fn flush_printed(printed: io::Result<()>) -> Result<(), Failure> {
    ignore_broken_pipe(printed.and_then(|()| io::stdout().flush()))
}

/// Shortens clap's error message to one line. The line contains the error and clap's tip, but not the usage.
#[must_use]
pub fn one_line_error(text: &str) -> String {
    let text = text.strip_prefix("error: ").unwrap_or(text);
    let wrong = text.split("\n\nUsage:").flat_map(|text| text.split("\n\nFor more information")).next();
    let lines = wrong.unwrap_or(text).lines().map(str::trim).filter(|line| !line.is_empty());
    // This tip is rarely useful: options take no such values, and files rarely have such names.
    let lines = lines.filter(|line| !line.starts_with("tip: to pass '"));
    let lines = lines.collect::<Vec<_>>().join(" ").replace(" tip: ", "; ");
    format!("{lines}; try '--help'")
}

/// Quotes a word for a shell if it contains characters with a special meaning there.
#[must_use]
pub fn shell_quoted(word: &str) -> Cow<'_, str> {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"_-./:=,@%+".contains(&byte);
    if !word.is_empty() && word.bytes().all(plain) {
        return Cow::Borrowed(word);
    }
    let quote = "'\\''";
    Cow::Owned(format!("'{}'", word.replace('\'', quote)))
}

/// Quotes a word that need not be UTF-8 or printable for a shell. Such a word becomes `$'...'`, which bash and zsh
/// support.
#[must_use]
pub fn shell_quoted_os(word: &OsStr) -> String {
    if let Some(word) = word.to_str().filter(|word| !word.contains(is_unprintable)) {
        return shell_quoted(word).into_owned();
    }
    let mut whole = "$'".to_owned();
    let escape = |whole: &mut String, bytes: &[u8]| {
        for byte in bytes {
            // Writing to a string cannot fail.
            let _ = write!(whole, r"\x{byte:02x}");
        }
    };
    for chunk in word.as_encoded_bytes().utf8_chunks() {
        for letter in chunk.valid().chars() {
            match letter {
                '\\' => whole += r"\\",
                '\'' => whole += r"\'",
                _ if is_unprintable(letter) => escape(&mut whole, letter.encode_utf8(&mut [0; 4]).as_bytes()),
                _ => whole.push(letter),
            }
        }
        escape(&mut whole, chunk.invalid());
    }
    whole + "'"
}

/// Returns the path in an environment variable, if the variable is set. A bare file name gets the prefix `./`, because
/// the system would otherwise search for it in `PATH`.
#[must_use]
pub fn path_from_env(variable: &str) -> Option<PathBuf> {
    let path = std::env::var_os(variable).filter(|path| !path.is_empty()).map(PathBuf::from)?;
    Some(if path.components().count() == 1 { Path::new(".").join(path) } else { path })
}

/// Returns the words of the command line, including the program name. Bytes that are not UTF-8 are replaced.
#[must_use]
pub fn command_line() -> Vec<String> {
    std::env::args_os().map(|word| word.to_string_lossy().into_owned()).collect()
}

#[cfg(test)]
mod tests {
    use std::os::unix::ffi::OsStrExt;

    use super::*;

    #[test]
    fn an_exit_code_goes_with_each_error() {
        assert_eq!(exit_code("test", Ok(())), ExitCode::SUCCESS);
        assert_eq!(exit_code("test", Err(Failure::already_reported())), ExitCode::from(1));
        assert_eq!(Failure::usage_error("no"), Failure::with_code(2, "no"));
        assert_eq!(Failure::run_error("no"), Failure::with_code(1, "no"));
        assert_eq!(exit_code("test", Err(Failure::with_code(3, ""))), ExitCode::from(3));
        assert_eq!(Failure::usage_error("no").append("no again"), Failure::usage_error("no; and no again"));
    }
    #[test]
    fn a_reader_may_leave_and_a_disk_may_not_be_full() {
        assert_eq!(ignore_broken_pipe(Ok(())), Ok(()));
        assert_eq!(ignore_broken_pipe(Err(ErrorKind::BrokenPipe.into())), Ok(()));
        let full = io::Error::from(ErrorKind::StorageFull);
        assert_eq!(
            ignore_broken_pipe(Err(full)),
            Err(Failure::run_error("standard output: no storage space"))
        );
    }
    #[test]
    fn what_is_wrong_and_its_tip_remain() {
        let said = "error: unexpected argument '--nod' found\n\n  tip: a similar argument exists: '--node'\n\n\
                    Usage: cell-node --bus <NAME>\n\nFor more information, try '--help'.\n";
        let expected =
            "unexpected argument '--nod' found ; a similar argument exists: '--node'; try '--help'";
        assert_eq!(one_line_error(said), expected.replace(" ; ", "; "));
        let said = "error: invalid value 'x' for '--node'\n\nFor more information, try '--help'.\n";
        assert_eq!(one_line_error(said), "invalid value 'x' for '--node'; try '--help'");
        let said = "error: unexpected argument '-1' found\n\n  tip: to pass '-1' as a value, use '-- -1'\n\n\
                    Usage: x [OPTIONS]\n\nFor more information, try '--help'.\n";
        assert_eq!(one_line_error(said), "unexpected argument '-1' found; try '--help'");
    }
    #[test]
    fn a_terminal_is_shown_controls_and_obeys_none() {
        assert!(matches!(printable("vcan0 µs — 中"), Cow::Borrowed("vcan0 µs — 中")));
        assert!(matches!(printable_lines("a\tb\n"), Cow::Borrowed("a\tb\n")));
        assert_eq!(printable("\x1b[2J\0\x7f"), r"\u{1b}[2J\u{0}\u{7f}");
        assert_eq!(printable("a\r\n\tb"), r"a\u{d}\u{a}\u{9}b");
        assert_eq!(printable_lines("a\r\n\tb\u{9b}"), "a\\u{d}\n\tb\\u{9b}");
        assert_eq!(printable("\u{80}\u{9f}\u{a0}"), "\\u{80}\\u{9f}\u{a0}");
        assert_eq!(printable("\u{202a}\u{202e}\u{2066}\u{2069}"), r"\u{202a}\u{202e}\u{2066}\u{2069}");
        assert_eq!(printable("\u{200f}\u{feff}\u{fffe}\u{1ffff}"), r"\u{200f}\u{feff}\u{fffe}\u{1ffff}");
        assert!(matches!(printable("\u{200d}\u{fffd}\u{ffee}\u{10000}"), Cow::Borrowed(_)));
        // A text that was made printable once does not change again.
        assert_eq!(printable(&printable("\x1b")), printable("\x1b"));
    }
    #[test]
    fn a_word_can_be_typed_again() {
        for plain in ["vcan0", "/tmp/a-b_c.toml", "--peer=x"] {
            assert_eq!(shell_quoted(plain), plain);
        }
        assert_eq!(shell_quoted("a b.toml"), "'a b.toml'");
        assert_eq!(shell_quoted("it's $HOME"), r"'it'\''s $HOME'");
        assert_eq!(shell_quoted(""), "''");
        assert_eq!(shell_quoted_os(OsStr::new("a b")), "'a b'");
        assert_eq!(shell_quoted_os(OsStr::from_bytes(b"it's\\\xff\xc3\xa9")), r"$'it\'s\\\xffé'");
    }
    #[test]
    fn the_shell_reads_a_quoted_word_as_it_was() {
        let unprintable = "line\nfeed\u{1b}[0m\u{202e}1'\\".as_bytes();
        for word in [b"n\xff.mcap".as_slice(), b"\xff\xfe'\\x41 $HOME", b"plain", b"two words", unprintable] {
            let word = OsStr::from_bytes(word);
            let script = format!("printf %s {}", shell_quoted_os(word));
            let read = std::process::Command::new("bash").args(["-c", &script]).output().unwrap();
            assert_eq!(OsStr::from_bytes(&read.stdout), word, "{script}");
            assert!(!script.contains(is_unprintable), "{script:?}");
        }
    }
}
