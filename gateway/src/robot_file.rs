//! The URDF of a skin's robot: read from the file that the skin names, or written from the skin's rows.

use std::fmt::Display;
use std::path::{Component, Path, PathBuf};

use protocol::document::MAX_FILE_BYTES;
use protocol::input;
use protocol::skin::Skin;
use protocol::usage::Failure;
use robots::Urdf;
use trace::files::parent_folder;
use trace::recording::robot::RecordedRobot;

use super::output::print_note;

/// Robot of a skin: its geometry for recordings, and the text of the URDF that the skin names.
#[derive(Default)]
pub(crate) struct SkinRobot {
    pub(crate) robot: Option<RecordedRobot>,
    pub(crate) urdf: Option<String>,
}

impl SkinRobot {
    /// Reads the robot from a URDF file if the skin names one, else from the skin's rows. Prints a note if the URDF is
    /// for another robot.
    ///
    /// # Errors
    /// Returns [`Failure`] if the file cannot be read or is not a URDF.
    pub(crate) fn read(skin: &Skin, file: Option<&Path>) -> Result<Self, Failure> {
        let of_rows = || {
            RecordedRobot::from_rows(skin)
                .map_err(|error| print_note(format_args!("the robot is not drawn: {error}")))
                .ok()
        };
        let Some(path) = file else { return Ok(Self { robot: of_rows(), urdf: None }) };
        let hint = "correct the path in the skin, or remove the key";
        let wrong = |error: &dyn Display| Failure::usage_error(format!("robot.urdf: {error}; {hint}"));
        let (urdf, text) = read_urdf(path).map_err(|error| wrong(&error))?;
        let robot = RecordedRobot::from_urdf(skin, urdf, text.clone());
        let robot = robot.or_else(|error| {
            print_note(format_args!("robot.urdf: {error}; the robot is drawn from the skin's rows instead"));
            of_rows().ok_or(())
        });
        Ok(Self { robot: robot.ok(), urdf: Some(text) })
    }
}

/// Reads a URDF in its declared encoding. Returns it with its text.
///
/// # Errors
/// Returns a one-line text if the file cannot be read or is not a URDF.
pub(crate) fn read_urdf(path: &Path) -> Result<(Urdf, String), String> {
    let file = path.display().to_string();
    let bytes = input::read_bytes(path, MAX_FILE_BYTES).map_err(|error| format!("{file}: {error}"))?;
    let text = robots::decode_text(&file, &bytes).map_err(|error| error.to_string())?.into_owned();
    let urdf = Urdf::parse(&file, &text).map_err(|error| error.to_string())?;
    Ok((urdf, text))
}

/// Returns the path of the URDF that a skin's file names.
pub(crate) fn urdf_path(skin: &Path, urdf: &str) -> PathBuf {
    skin.parent().unwrap_or_else(|| Path::new("")).join(urdf)
}

/// Returns the path of a file relative to the directory of another file, which need not exist. Returns `None` if a
/// directory does not exist, or if a name is not UTF-8.
pub(crate) fn relative_path(file: &Path, to: &Path) -> Option<String> {
    let real = |path: &Path| {
        let folder = parent_folder(path);
        folder.canonicalize().ok()
    };
    let (from, folder) = (real(file)?, real(to)?);
    let to = folder.join(to.file_name()?);
    let shared = from.components().zip(to.components()).take_while(|(one, other)| one == other).count();
    let up = from.components().skip(shared).map(|_| Component::ParentDir);
    let path: PathBuf = up.chain(to.components().skip(shared)).collect();
    path.to_str().map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_path_leads_from_the_skin_to_the_urdf() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join(name);
        fs::create_dir_all(at("skins/new")).unwrap();
        fs::create_dir(at("robots")).unwrap();
        fs::write(at("robots/arm.urdf"), "x").unwrap();
        for (skin, path) in [
            ("arm.toml", "robots/arm.urdf"),
            ("robots/arm.toml", "arm.urdf"),
            ("skins/new/arm.toml", "../../robots/arm.urdf"),
        ] {
            assert_eq!(relative_path(&at(skin), &at("robots/arm.urdf")).as_deref(), Some(path));
            assert_eq!(fs::read_to_string(urdf_path(&at(skin), path)).unwrap(), "x");
        }
        assert_eq!(relative_path(&at("nowhere/arm.toml"), &at("robots/arm.urdf")), None);
    }
}
