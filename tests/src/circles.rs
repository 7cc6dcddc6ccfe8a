//! Circles of files: files of one crate that use each other in a ring, so that none of them can be read or changed alone.
//!
//! An arrow leads from a file to each file that defines a name it uses; re-exports are followed to the definition. A
//! module and those inside it count as one place, so arrows between them are left out. Unit tests are too.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use quote::ToTokens;
use syn::{Attribute, Item, UseTree};

/// The largest number of circles; it only goes down.
const MOST: usize = 0;

/// The path of a module or of an item, from the crate's root.
type Names = Vec<String>;

/// The names that one module file defines, imports and uses.
#[derive(Default)]
struct Module {
    file: PathBuf,
    /// Names of items, and of modules in the same file.
    defined: BTreeSet<String>,
    /// Imported names with the paths they stand for.
    imported: BTreeMap<String, Names>,
    /// Modules whose names are all imported.
    globs: Vec<Names>,
    /// Paths that occur, relative to the crate's root.
    used: BTreeSet<Names>,
}

/// The modules of one crate, each a file.
type Modules = BTreeMap<Names, Module>;

fn is_of_tests(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        let text = attribute.meta.to_token_stream().to_string();
        text == "test" || text.starts_with("cfg (test") || text.starts_with("cfg (all (test")
    })
}

fn attributes(item: &Item) -> &[Attribute] {
    match item {
        Item::Const(it) => &it.attrs,
        Item::Enum(it) => &it.attrs,
        Item::Fn(it) => &it.attrs,
        Item::Impl(it) => &it.attrs,
        Item::Macro(it) => &it.attrs,
        Item::Mod(it) => &it.attrs,
        Item::Static(it) => &it.attrs,
        Item::Struct(it) => &it.attrs,
        Item::Trait(it) => &it.attrs,
        Item::Type(it) => &it.attrs,
        Item::Use(it) => &it.attrs,
        _ => &[],
    }
}

fn defined(item: &Item) -> Option<String> {
    let ident = match item {
        Item::Const(it) => &it.ident,
        Item::Enum(it) => &it.ident,
        Item::Fn(it) => &it.sig.ident,
        Item::Macro(it) => it.ident.as_ref()?,
        Item::Static(it) => &it.ident,
        Item::Struct(it) => &it.ident,
        Item::Trait(it) => &it.ident,
        Item::Type(it) => &it.ident,
        _ => return None,
    };
    Some(ident.to_string())
}

/// Turns a path as it is written in a module into one from the crate's root; `None` where it leads out of the crate.
fn absolute(written: &[String], here: &[String], module: &Module) -> Option<Names> {
    let (first, rest) = written.split_first()?;
    let mut path = match first.as_str() {
        "crate" => Vec::new(),
        "self" => here.to_vec(),
        "super" => here[..here.len().checked_sub(1)?].to_vec(),
        name => match module.imported.get(name) {
            Some(path) => path.clone(),
            None if module.defined.contains(name) => [here, std::slice::from_ref(first)].concat(),
            None => return None,
        },
    };
    for name in rest {
        match name.as_str() {
            "super" => drop(path.pop()),
            "self" => {}
            name => path.push(name.to_owned()),
        }
    }
    Some(path)
}

/// Flattens a `use` into the names it brings with their paths; a glob has the name `*`.
fn flatten(tree: &UseTree, path: &mut Names, found: &mut Vec<(String, Names)>) {
    match tree {
        UseTree::Path(it) => {
            path.push(it.ident.to_string());
            flatten(&it.tree, path, found);
            path.pop();
        }
        UseTree::Name(it) if it.ident == "self" => found.push((path.last().unwrap().clone(), path.clone())),
        UseTree::Name(it) => {
            found.push((it.ident.to_string(), [path.clone(), vec![it.ident.to_string()]].concat()))
        }
        UseTree::Rename(it) => {
            found.push((it.rename.to_string(), [path.clone(), vec![it.ident.to_string()]].concat()));
        }
        UseTree::Glob(_) => found.push(("*".to_owned(), path.clone())),
        UseTree::Group(it) => it.items.iter().for_each(|tree| flatten(tree, path, found)),
    }
}

/// Collects the paths of two names or more that a text of tokens holds, and names alone.
fn paths(text: &str) -> Vec<Names> {
    // Tokens are separated by spaces when they are printed.
    let mut found: Vec<Names> = Vec::new();
    let mut joined = false;
    for token in text.split_whitespace() {
        if token == "::" {
            joined = true;
            continue;
        }
        let is_name = token.starts_with(|first: char| first.is_alphabetic() || first == '_')
            && token.chars().all(|it| it.is_alphanumeric() || it == '_');
        match (is_name, joined, found.last_mut()) {
            (true, true, Some(path)) => path.push(token.to_owned()),
            (true, ..) => found.push(vec![token.to_owned()]),
            (false, ..) => found.push(Vec::new()),
        }
        joined = false;
    }
    found.retain(|path| !path.is_empty());
    found
}

/// Reads a module file and those it declares.
fn read(file: &Path, names: &[String], modules: &mut Modules) {
    let text = fs::read_to_string(file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    let parsed = syn::parse_file(&text).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    let stem = file.file_stem().unwrap();
    let is_folder = ["mod", "lib", "main"].iter().any(|name| stem == *name);
    let folder = if is_folder { file.parent().unwrap().to_owned() } else { file.with_extension("") };
    let mut module = Module { file: file.to_owned(), ..Module::default() };
    let items: Vec<_> = parsed.items.iter().filter(|item| !is_of_tests(attributes(item))).collect();
    for item in &items {
        module.defined.extend(defined(item));
        if let Item::Mod(it) = item {
            module.defined.insert(it.ident.to_string());
            if it.content.is_none() {
                let name = it.ident.to_string();
                let at = [folder.join(format!("{name}.rs")), folder.join(&name).join("mod.rs")];
                let child = at.iter().find(|path| path.exists());
                let inner = [names, &[name]].concat();
                child.into_iter().for_each(|path| read(path, &inner, modules));
            }
        }
    }
    let mut uses = Vec::new();
    for item in &items {
        if let Item::Use(it) = item {
            flatten(&it.tree, &mut Vec::new(), &mut uses);
        }
    }
    for (name, written) in uses {
        let Some(path) = absolute(&written, names, &module) else { continue };
        if name == "*" {
            module.globs.push(path.clone());
        } else {
            module.imported.insert(name, path.clone());
        }
        module.used.insert(path);
    }
    for item in items.iter().filter(|item| !matches!(item, Item::Use(_))) {
        let written = paths(&item.to_token_stream().to_string());
        let used: Vec<_> = written.iter().filter_map(|path| absolute(path, names, &module)).collect();
        module.used.extend(used);
    }
    modules.insert(names.to_vec(), module);
}

/// Finds the module that defines what a path leads to, through re-exports.
fn definer<'a>(path: &[String], modules: &'a Modules, depth: usize) -> Option<&'a Names> {
    if depth > 8 {
        return None;
    }
    let length = (0..=path.len()).rev().find(|&length| modules.contains_key(&path[..length]))?;
    let (names, module) = modules.get_key_value(&path[..length])?;
    let Some(item) = path.get(length) else { return Some(names) };
    if module.defined.contains(item) {
        return Some(names);
    }
    if let Some(imported) = module.imported.get(item) {
        return definer(&[imported.as_slice(), &path[length + 1..]].concat(), modules, depth + 1);
    }
    let within = |glob: &Names| [glob.as_slice(), &path[length..]].concat();
    module.globs.iter().find_map(|glob| {
        let names = definer(&within(glob), modules, depth + 1)?;
        modules[names].defined.contains(item).then_some(names)
    })
}

/// The circles of one crate, each a sorted list of its files.
fn circles(modules: &Modules) -> Vec<Vec<&Names>> {
    let mut arrows: BTreeMap<&Names, BTreeSet<&Names>> = BTreeMap::new();
    for (names, module) in modules {
        for path in &module.used {
            if let Some(to) = definer(path, modules, 0)
                && !to.starts_with(names)
                && !names.starts_with(to)
            {
                arrows.entry(names).or_default().insert(to);
            }
        }
    }
    let reach = |from| {
        let (mut seen, mut next) = (BTreeSet::new(), vec![from]);
        while let Some(at) = next.pop() {
            next.extend(arrows.get(at).into_iter().flatten().filter(|to| seen.insert(**to)));
        }
        seen
    };
    let reached: BTreeMap<_, _> = modules.keys().map(|names| (names, reach(names))).collect();
    let mut found = BTreeSet::new();
    for (from, all) in &reached {
        if all.contains(*from) {
            found.insert(all.iter().copied().filter(|to| reached[*to].contains(*from)).collect::<Vec<_>>());
        }
    }
    if std::env::var_os("SKINBUS_CIRCLES").is_some() {
        for (from, to) in
            found.iter().flatten().flat_map(|from| arrows[*from].iter().map(move |to| (from, to)))
        {
            if reached[*to].contains(*from) {
                println!("  {} -> {}", from.join("::"), to.join("::"));
            }
        }
    }
    found.into_iter().collect()
}

#[test]
fn files_of_one_crate_use_each_other_in_one_direction() {
    let top = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let manifest: String = fs::read_to_string(top.join("Cargo.toml")).unwrap();
    let (_, members) = manifest.split_once("members = [").unwrap();
    let members = members.split_once(']').unwrap().0.split('"').skip(1).step_by(2);
    let mut found = Vec::new();
    for member in members {
        for root in ["lib.rs", "main.rs"] {
            let file = top.join(member).join("src").join(root);
            if !file.exists() {
                continue;
            }
            let mut modules = Modules::new();
            read(&file, &[], &mut modules);
            for circle in circles(&modules) {
                let name =
                    |names: &&Names| modules[*names].file.strip_prefix(top).unwrap().display().to_string();
                found.push(circle.iter().map(name).collect::<Vec<_>>());
            }
        }
    }
    assert!(found.len() <= MOST, "{} circles of files: {found:#?}", found.len());
}
