//! The URDF that a skin names.

use std::path::{Component, Path, PathBuf};

use trace::files::folder_of;

/// Where the URDF of a skin's file is.
pub(crate) fn urdf_of(skin: &Path, urdf: &str) -> PathBuf {
    skin.parent().unwrap_or_else(|| Path::new("")).join(urdf)
}

/// The path of a file as seen from the folder of another one, which need not be there yet; `None` when a folder is
/// not there, or a name is not UTF-8.
pub(crate) fn path_from(file: &Path, to: &Path) -> Option<String> {
    let real = |path: &Path| {
        let folder = folder_of(path);
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
            assert_eq!(path_from(&at(skin), &at("robots/arm.urdf")).as_deref(), Some(path));
            assert_eq!(fs::read_to_string(urdf_of(&at(skin), path)).unwrap(), "x");
        }
        assert_eq!(path_from(&at("nowhere/arm.toml"), &at("robots/arm.urdf")), None);
    }
}
