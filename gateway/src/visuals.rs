//! Appearance of a robot's links: the shapes of a URDF as meshes, from the files that it names.

use std::path::{Path, PathBuf};

use clap::Args;
use cover::LinkMesh;
use cover::mesh::{Mesh, MeshError, UpAxis};
use robots::{Geometry, Shape, Urdf};
use trace::files::parent_folder;

/// Directories of the packages that a URDF refers to.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct PackageOptions {
    /// Directory of the files that the URDF names as package://NAME/...; repeat the option for further packages.
    /// Default: search the directory of the URDF and those above it
    #[arg(long, value_name = "NAME=DIR", value_parser = package)]
    package: Vec<(String, PathBuf)>,
    /// True for commands that do not have this option.
    #[arg(skip)]
    only_beside: bool,
}

impl PackageOptions {
    /// Creates a search in the directory of the URDF and those above it, for commands without the option.
    pub(crate) fn search_beside_urdf() -> Self {
        Self { package: Vec::new(), only_beside: true }
    }
}

fn package(text: &str) -> Result<(String, PathBuf), String> {
    match text.split_once('=') {
        Some((name, folder)) if !name.is_empty() && !folder.is_empty() => {
            Ok((name.to_owned(), folder.into()))
        }
        _ => Err("use NAME=DIR: the package of package://NAME/... and its directory".to_owned()),
    }
}

/// Shapes of a robot's links, from a URDF and the mesh files that it names.
pub(crate) struct Visuals<'a> {
    urdf: &'a Urdf,
    /// Directory of the URDF.
    folder: PathBuf,
    packages: &'a PackageOptions,
}

impl<'a> Visuals<'a> {
    /// Creates the shapes of the URDF in this file.
    pub(crate) fn new(urdf: &'a Urdf, file: &Path, packages: &'a PackageOptions) -> Self {
        let folder = parent_folder(file);
        // Resolve the path, because `.` has no parent directories.
        let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
        Self { urdf, folder, packages }
    }

    /// Returns the parts of a link's shape. The list is empty if the URDF has no visual for the link.
    pub(crate) fn link_parts(&self, link: &str) -> Result<Vec<LinkMesh>, String> {
        let shapes = self.urdf.visuals(link).map_err(|error| error.to_string())?;
        let part = |shape| {
            self.read_link_mesh(shape).map_err(|error| format!("{}: link {link}: {error}", self.urdf.file))
        };
        shapes.iter().map(part).collect()
    }

    fn read_link_mesh(&self, shape: &Shape) -> Result<LinkMesh, String> {
        let plain =
            |mesh: Result<Mesh, MeshError>| mesh.map(LinkMesh::new).map_err(|error| error.to_string());
        let part = match &shape.geometry {
            Geometry::Mesh { path, scale } => {
                let mesh = Mesh::load(&self.find_file(path)?, UpAxis::Ignore);
                LinkMesh { scale: *scale, ..plain(mesh)? }
            }
            Geometry::Box { size } => plain(Mesh::cuboid(*size))?,
            Geometry::Cylinder { radius, length } => plain(Mesh::cylinder(*radius, *length))?,
            Geometry::Sphere { radius } => plain(Mesh::sphere(*radius))?,
            Geometry::Other { element } => {
                return Err(format!(
                    "visual {element:?} is not supported: use mesh, box, cylinder or sphere"
                ));
            }
            other => return Err(format!("visual {other:?} is not supported: use a mesh")),
        };
        Ok(LinkMesh { pose: shape.origin, ..part })
    }

    /// Finds the file that a URI or a path of the URDF names.
    fn find_file(&self, uri: &str) -> Result<PathBuf, String> {
        let of_package = uri.strip_prefix("package://").or_else(|| uri.strip_prefix("model://"));
        let Some((name, rest)) = of_package.map(|path| path.split_once('/').unwrap_or((path, ""))) else {
            let local = path_of_uri(uri);
            let tried = path_spellings(local, local != uri).map(|path| self.folder.join(path));
            let tried: Vec<_> = tried.collect();
            let shown = tried.first().map_or_else(String::new, |path| path.display().to_string());
            let found = tried.into_iter().find(|path| path.is_file());
            return found.ok_or_else(|| format!("mesh {uri}: {shown} is not a file: correct the path"));
        };
        let rests: Vec<_> = path_spellings(rest, true).collect();
        let given = self.packages.package.iter().find(|(known, _)| known == name);
        let tried: Vec<_> = match given {
            Some((_, folder)) => rests.iter().map(|rest| folder.join(rest)).collect(),
            None => self
                .folder
                .ancestors()
                .flat_map(|above| {
                    let is_it = above.file_name().is_some_and(|it| it == name);
                    let folders = [is_it.then(|| above.to_owned()), Some(above.join(name))];
                    folders
                        .into_iter()
                        .flatten()
                        .flat_map(|folder| rests.iter().map(move |rest| folder.join(rest)))
                })
                .collect(),
        };
        if let Some(path) = tried.iter().find(|path| path.is_file()) {
            return Ok(path.clone());
        }
        // Prefer a directory that has the package's name.
        let named =
            |path: &&PathBuf| given.is_some() || path.ancestors().any(|it| it.ends_with(name) && it.is_dir());
        let shown = tried
            .iter()
            .find(named)
            .or_else(|| tried.first())
            .map_or_else(String::new, |path| path.display().to_string());
        let hint = match given {
            Some((_, folder)) if folder.is_dir() => {
                format!(
                    "{} is not the directory of the package, or lacks this file: correct --package, or add the file",
                    folder.display()
                )
            }
            Some((_, folder)) => format!("{} is not a folder: correct --package {name}=", folder.display()),
            None if self.packages.only_beside => {
                format!("put the folder of package {name} beside the URDF, or above it")
            }
            None => format!("name its directory with --package {name}=DIR"),
        };
        Err(format!("mesh {uri}: {shown} is not a file: {hint}"))
    }
}

/// Returns the path of a `file:` URI; any other text is a path already.
fn path_of_uri(uri: &str) -> &str {
    let Some(rest) = uri.strip_prefix("file:") else { return uri };
    let local = rest.strip_prefix("//localhost").filter(|path| path.starts_with('/'));
    local.or_else(|| rest.strip_prefix("//")).unwrap_or(rest)
}

/// Returns a path as written and, for a URI, also with its escapes such as `%20` decoded.
fn path_spellings(path: &str, is_uri: bool) -> impl Iterator<Item = String> {
    let decoded = is_uri.then(|| percent_decode(path)).flatten().filter(|decoded| decoded != path);
    core::iter::once(path.to_owned()).chain(decoded)
}

fn percent_decode(path: &str) -> Option<String> {
    let mut parts = path.split('%');
    let mut bytes = parts.next().unwrap_or_default().as_bytes().to_vec();
    for part in parts {
        bytes.push(u8::from_str_radix(part.get(..2)?, 16).ok()?);
        bytes.extend(part.get(2..)?.bytes());
    }
    String::from_utf8(bytes).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_without_the_option_does_not_name_it() {
        let urdf = Urdf::parse("r.urdf", "<robot><link name=\"a\"/></robot>").unwrap();
        let hint = |packages: &PackageOptions| {
            Visuals::new(&urdf, Path::new("none/r.urdf"), packages)
                .find_file("package://p/a.stl")
                .unwrap_err()
        };
        assert!(hint(&PackageOptions::default()).ends_with("name its directory with --package p=DIR"));
        let beside = hint(&PackageOptions::search_beside_urdf());
        assert!(beside.ends_with("put the folder of package p beside the URDF, or above it"), "{beside}");
    }

    #[test]
    fn uris_name_files() {
        for (uri, path) in [
            ("file:///a/b.stl", "/a/b.stl"),
            ("file://localhost/a/b.stl", "/a/b.stl"),
            ("file:/a/b.stl", "/a/b.stl"),
            ("file://a/b.stl", "a/b.stl"),
            ("a/b.stl", "a/b.stl"),
        ] {
            assert_eq!(path_of_uri(uri), path);
        }
        let of_uri = |path| path_spellings(path, true).collect::<Vec<_>>();
        assert_eq!(of_uri("a%20b%C3%BC.stl"), ["a%20b%C3%BC.stl", "a b\u{fc}.stl"]);
        for plain in ["ab", "a%2", "a%zz", "a%ff"] {
            assert_eq!(of_uri(plain), [plain]);
        }
        assert_eq!(path_spellings("a%20b", false).collect::<Vec<_>>(), ["a%20b"]);
    }
}
