//! Tests of the search for circles, on small crates.

use std::fs;

use tempfile::TempDir;

use super::circles;
use super::modules::Modules;

/// Returns the circles of a crate that has these files.
fn found(files: &[(&str, &str)]) -> Vec<Vec<String>> {
    let folder = TempDir::new().unwrap();
    for (name, text) in files {
        let file = folder.path().join(name);
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(file, text).unwrap();
    }
    let modules = Modules::read(&folder.path().join("lib.rs"));
    let name = |file: &std::path::Path| file.strip_prefix(folder.path()).unwrap().display().to_string();
    circles(&modules).into_iter().map(|files| files.into_iter().map(name).collect()).collect()
}

/// Returns true if `a.rs` and `b.rs` form a circle, where `b.rs` needs `a.rs` and `a.rs` has this text.
fn is_one(root: &str, a: &str) -> bool {
    let b = "pub struct B; pub enum Kind { One } pub fn make(_: crate::a::A) {}";
    let found = found(&[("lib.rs", root), ("a.rs", &format!("{a} pub struct A;")), ("b.rs", b)]);
    assert!(found.is_empty() || found == [["a.rs", "b.rs"]], "{found:?}");
    !found.is_empty()
}

#[test]
fn a_circle_is_found_however_a_name_is_written() {
    let plain = "mod a; mod b;";
    for (root, a) in [
        (plain, "fn f(_: crate::b::B) {}"),
        (plain, "use super::b::B;"),
        (plain, "use super::b::B as _;"),
        (plain, "use {super::{b::{self as other}}}; fn f(_: other::B) {}"),
        // In functions and in parts of the file.
        (plain, "fn f() { use super::b::{make as produce}; produce(A) }"),
        (plain, "mod part { fn f(_: super::super::b::B) {} }"),
        (plain, "mod part { use crate::b; mod part { use super::b::Kind; } }"),
        // In macros and attributes.
        (plain, "fn f() { println!(\"{}\", { use crate::{b::make, b}; make(super::A) }) }"),
        (plain, "macro_rules! m { () => { $crate::b::make(A) } }"),
        (plain, "#[serde(with = \"super::b\")] struct C;"),
        (plain, "#[arg(value_parser = crate::b::make)] struct C;"),
        // By globs.
        ("mod a; mod b; use b::B;", "use super::*; fn f(_: B) {}"),
        ("mod a; mod b; pub use b::*;", "use super::*; fn f() { make(A) }"),
        ("mod a; mod b; use b as other;", "use super::*; fn f() { other::make(A) }"),
        (plain, "use super::b::Kind::*;"),
        (plain, "mod part { pub use crate::b::*; } fn f(_: part::B) {}"),
        // By re-exports.
        ("mod a; mod b; pub use b::B as Other;", "use super::Other; fn f(_: Other) {}"),
        ("mod a; mod b; mod c { pub use crate::b::B as Other; } pub use c::*;", "fn f(_: crate::Other) {}"),
        (
            "mod a; mod b; mod c { pub mod d { pub use crate::b as other; } }",
            "use crate::c::d::other::Kind::One;",
        ),
    ] {
        assert!(is_one(root, a), "{root}\n{a}");
    }
}

#[test]
fn a_macro_is_used_without_an_import() {
    let (a, b) = ("macro_rules! m { () => {} } fn f(_: crate::b::B) {}", "m!(); pub struct B;");
    let files = [("lib.rs", "#[macro_use] mod a; mod b;"), ("a.rs", a), ("b.rs", b)];
    assert_eq!(found(&files), [["a.rs", "b.rs"]]);
}

#[test]
fn what_only_looks_like_a_use_is_none() {
    let plain = "mod a; mod b;";
    for (root, a) in [
        // Text, and names of other things.
        (plain, "/// [`super::b::B`], see crate::b::B.\nfn f() -> &'static str { \"super::b::B\" }"),
        (
            "mod a; mod b; use b::*;",
            "use super::*; struct C { make: u8 } fn f(c: C) -> u8 { let make = c.make; make }",
        ),
        (plain, "use other::b::B; fn f(_: b::B, _: ::b::B) {}"),
        ("mod a; mod b; pub use b::B;", "use super::*; use other::B; fn f(_: B) {}"),
        // In tests.
        (plain, "#[cfg(test)] mod tests { use crate::b::B; }"),
        (plain, "#[cfg(test)] use crate::b::B; struct C { #[cfg(test)] b: crate::b::B, c: u8 }"),
        (plain, "impl A { #[cfg(test)] #[must_use] fn f(_: crate::b::B) -> u8 { 0 } }"),
    ] {
        assert!(!is_one(root, a), "{root}\n{a}");
    }
    // Code after such a field or function counts again.
    assert!(is_one(plain, "struct C { #[cfg(test)] c: u8, b: crate::b::B }"));
    assert!(is_one(plain, "impl A { #[cfg(test)] fn f() {} fn g(_: crate::b::B) {} }"));
}

#[test]
fn a_module_and_those_inside_it_are_one_place() {
    let files = [
        ("lib.rs", "mod a;"),
        ("a/mod.rs", "mod b; mod c; pub struct A; use b::B;"),
        ("a/b.rs", "use super::A; use super::c::C; pub struct B;"),
        ("a/c.rs", "pub struct C;"),
    ];
    assert!(found(&files).is_empty());
    let back = ("a/c.rs", "#[path = \"other.rs\"] mod d;");
    let files = [files[0], files[1], files[2], back, ("a/other.rs", "use crate::a::b::B;")];
    assert!(found(&files).is_empty());
    let back = ("a/c.rs", "pub struct C; use crate::a::b::B;");
    assert_eq!(found(&[files[0], files[1], files[2], back]), [["a/b.rs", "a/c.rs"]]);
}
