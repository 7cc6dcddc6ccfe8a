//! The modules of a crate, with the names that each defines, imports and uses.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use quote::ToTokens;
use syn::{Expr, Item, ItemMod, Lit, Meta};

use super::Names;
use super::tokens::{UsedNames, is_of_tests};

/// A module: a file, or a part of one in braces.
#[derive(Default)]
struct Module {
    /// The module of the file that contains this module.
    file: Names,
    /// The names of the items and modules that this module defines.
    defined: BTreeSet<String>,
    /// Imported names with the paths that they stand for; several if functions import different ones.
    imported: BTreeMap<String, Vec<Names>>,
    /// Modules or enums whose names are all imported.
    globs: Vec<Names>,
    /// The paths that the module uses, from the crate's root; a path of a single name may not exist there.
    used: BTreeSet<Names>,
}

/// The modules of one crate.
#[derive(Default)]
pub(super) struct Modules {
    by_path: BTreeMap<Names, Module>,
    /// The files of those modules that have a file of their own.
    pub(super) files: BTreeMap<Names, PathBuf>,
    /// The modules that define macros by rules, which can be used without an import.
    macros: BTreeMap<String, Names>,
}

impl Modules {
    /// Reads a crate from its root file.
    pub(super) fn read(root: &Path) -> Self {
        let mut modules = Self::default();
        modules.read_file(root, &[]);
        modules
    }

    fn read_file(&mut self, file: &Path, names: &[String]) {
        let text = fs::read_to_string(file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        let parsed = syn::parse_file(&text).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        let stem = file.file_stem().unwrap();
        let is_folder = ["mod", "lib", "main"].iter().any(|name| stem == *name);
        let folder = if is_folder { file.parent().unwrap().to_owned() } else { file.with_extension("") };
        self.files.insert(names.to_vec(), file.to_owned());
        self.read_items(&parsed.items, (file, &folder), names, names);
    }

    /// Reads the items of a module; `folder` contains the modules that have files of their own.
    fn read_items(
        &mut self,
        items: &[Item],
        (file, folder): (&Path, &Path),
        names: &[String],
        of_file: &[String],
    ) {
        let mut module = Module { file: of_file.to_vec(), ..Module::default() };
        let mut named = UsedNames::default();
        for item in items {
            let Item::Mod(it) = item else {
                if let Item::Macro(it) = item
                    && let Some(ident) = &it.ident
                {
                    self.macros.insert(ident.to_string(), names.to_vec());
                }
                module.defined.extend(defined(item));
                named.add(item.to_token_stream());
                continue;
            };
            if it.attrs.iter().any(|attribute| is_of_tests(&attribute.meta.to_token_stream())) {
                continue;
            }
            let name = it.ident.to_string();
            let inner = [names, std::slice::from_ref(&name)].concat();
            match &it.content {
                Some((_, items)) => self.read_items(items, (file, &folder.join(&name)), &inner, of_file),
                None => self.read_file(&file_of(it, file, folder), &inner),
            }
            module.defined.insert(name);
        }
        module.used = named.paths.iter().filter_map(|path| from_root(path, names)).collect();
        for (name, path) in named.imports {
            let Some(path) = from_root(&path, names) else { continue };
            module.used.insert(path.clone());
            match name.as_str() {
                "*" => module.globs.push(path),
                _ => module.imported.entry(name).or_default().push(path),
            }
        }
        self.by_path.insert(names.to_vec(), module);
    }

    /// Returns the arrows from each file to the other files that define names it uses.
    pub(super) fn arrows(&self) -> BTreeMap<&Names, BTreeSet<&Names>> {
        let mut arrows: BTreeMap<_, BTreeSet<_>> = BTreeMap::new();
        for module in self.by_path.values() {
            let used = module.used.iter().filter_map(|path| self.file_that_defines(path));
            arrows.entry(&module.file).or_default().extend(used.filter(|to| **to != module.file));
        }
        arrows
    }

    fn file_that_defines(&self, path: &[String]) -> Option<&Names> {
        let macro_name = path.last().and_then(|name| name.strip_suffix('!'));
        let path = macro_name.map_or_else(
            || path.to_vec(),
            |name| [path.split_last().map_or(&[][..], |(_, before)| before), &[name.to_owned()]].concat(),
        );
        let home = self.home(&path, 0).or_else(|| self.macros.get(macro_name?).cloned())?;
        Some(&self.module_of(&home)?.1.file)
    }

    /// Returns the innermost module on a path, with its depth.
    fn module_of(&self, path: &[String]) -> Option<(usize, &Module)> {
        (0..=path.len()).rev().find_map(|length| Some((length, self.by_path.get(&path[..length])?)))
    }

    /// Returns the path of the definition of a name, following imports and re-exports.
    fn home(&self, path: &[String], depth: usize) -> Option<Names> {
        let (length, module) = self.module_of(path).filter(|_| depth < 8)?;
        let Some(item) = path.get(length).filter(|item| !module.defined.contains(*item)) else {
            return Some(path.to_vec());
        };
        let follow = |to: &Names, from: usize| self.home(&[to, &path[from..]].concat(), depth + 1);
        match module.imported.get(item) {
            Some(all) => all.iter().find_map(|to| follow(to, length + 1)),
            None => module.globs.iter().find_map(|glob| {
                // An enum counts as the home of its variants.
                let glob = self.home(glob, depth + 1).filter(|glob| self.by_path.contains_key(glob))?;
                follow(&glob, length)
            }),
        }
    }
}

/// Resolves a path as written in a module to one from the crate's root; returns `None` if it leads out of the crate.
fn from_root(written: &[String], here: &[String]) -> Option<Names> {
    let mut path = if written.first()? == "crate" { Vec::new() } else { here.to_vec() };
    for name in written {
        match name.as_str() {
            "crate" | "self" => {}
            "super" => drop(path.pop()?),
            "" => return None,
            name => path.push(name.to_owned()),
        }
    }
    Some(path)
}

/// Returns the file of a module that has its own.
fn file_of(module: &ItemMod, file: &Path, folder: &Path) -> PathBuf {
    let name = module.ident.to_string();
    let given = module.attrs.iter().find_map(|attribute| match &attribute.meta {
        Meta::NameValue(it) if it.path.is_ident("path") => match &it.value {
            Expr::Lit(it) => match &it.lit {
                Lit::Str(text) => Some(file.with_file_name(text.value())),
                _ => None,
            },
            _ => None,
        },
        _ => None,
    });
    let at = [folder.join(format!("{name}.rs")), folder.join(&name).join("mod.rs")];
    let found = given.into_iter().chain(at).find(|path| path.exists());
    found.unwrap_or_else(|| panic!("{}: no file of the module {name}", file.display()))
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
        Item::TraitAlias(it) => &it.ident,
        Item::Type(it) => &it.ident,
        Item::Union(it) => &it.ident,
        _ => return None,
    };
    Some(ident.to_string())
}
