//! Finds the paths and the imports in a piece of a source file by its tokens, also those in macros and attributes.

use std::collections::BTreeSet;

use proc_macro2::{Delimiter, TokenStream, TokenTree};

use super::Names;

/// The paths and imports that a source contains.
#[derive(Default)]
pub(super) struct UsedNames {
    /// Paths as they are written. A single name is included if it is a type, a constant or a call, whose `use` may be a
    /// glob; the name of a macro ends with `!`.
    pub(super) paths: BTreeSet<Names>,
    /// The names that a `use` imports, at the top or in a function, with the paths that they stand for; `*` for a glob.
    pub(super) imports: Vec<(String, Names)>,
}

/// Returns true if an attribute, or the text in its brackets, marks an item as a unit test.
pub(super) fn is_of_tests(attribute: &TokenStream) -> bool {
    let text = attribute.to_string();
    text == "test" || ["cfg (test", "cfg (all (test"].iter().any(|of_tests| text.starts_with(of_tests))
}

impl UsedNames {
    /// Adds the names in these tokens.
    pub(super) fn add(&mut self, tokens: TokenStream) {
        let tokens: Vec<_> = tokens.into_iter().collect();
        let mut at = 0;
        while let Some(token) = tokens.get(at) {
            at = match token {
                TokenTree::Ident(word) if word == "use" && !is_sign(&tokens, at + 1, '<') => {
                    self.import(&tokens, at + 1, Vec::new())
                }
                TokenTree::Ident(_) if is_part_of_another(&tokens, at) => at + 1,
                TokenTree::Ident(_) => self.path(&tokens, at),
                TokenTree::Group(group) => {
                    self.add(group.stream());
                    at + 1
                }
                TokenTree::Punct(sign) if sign.as_char() == '#' => self.attribute(&tokens, at + 1),
                TokenTree::Punct(_) | TokenTree::Literal(_) => at + 1,
            };
        }
    }

    /// Adds the path that begins here, and returns the index of its end.
    fn path(&mut self, tokens: &[TokenTree], from: usize) -> usize {
        let (mut path, mut at) = (vec![tokens[from].to_string()], from + 1);
        while is_joined(tokens, at)
            && let Some(TokenTree::Ident(name)) = tokens.get(at + 2)
        {
            path.push(name.to_string());
            at += 3;
        }
        if let [name] = &mut path[..] {
            let group = |at| matches!(tokens.get(at), Some(TokenTree::Group(_)));
            if is_sign(tokens, at, '!') && group(at + 1) {
                name.push('!');
            } else if !name.starts_with(char::is_uppercase) && !is_group(tokens, at, Delimiter::Parenthesis) {
                return at;
            }
        }
        self.paths.insert(path);
        at
    }

    /// Adds the tree of a `use` that follows the names `path`, and returns the index of its end.
    fn import(&mut self, tokens: &[TokenTree], mut at: usize, mut path: Names) -> usize {
        loop {
            match tokens.get(at) {
                Some(TokenTree::Ident(name)) => {
                    path.push(name.to_string());
                    at += 1;
                }
                Some(TokenTree::Group(group)) => {
                    let (inner, mut within) = (Vec::from_iter(group.stream()), 0);
                    while within < inner.len() {
                        within = self.import(&inner, within, path.clone()) + 1;
                    }
                    return at + 1;
                }
                _ if is_sign(tokens, at, '*') => {
                    self.imports.push(("*".to_owned(), path));
                    return at + 1;
                }
                // `::` at the beginning leads to another crate.
                _ if is_joined(tokens, at) => path.push(String::new()),
                _ => return at,
            }
            if is_joined(tokens, at) {
                at += 2;
                continue;
            }
            path.pop_if(|name| name == "self");
            let mut name = path.last().cloned().unwrap_or_default();
            if matches!(tokens.get(at), Some(TokenTree::Ident(word)) if word == "as") {
                name = tokens[at + 1].to_string();
                at += 2;
            }
            self.imports.push((name, path));
            return at;
        }
    }

    /// Adds an attribute whose brackets come next. Returns the index of its end, or that of its item's end if the item
    /// is for tests.
    fn attribute(&mut self, tokens: &[TokenTree], mut at: usize) -> usize {
        at += usize::from(is_sign(tokens, at, '!'));
        let Some(TokenTree::Group(group)) = tokens.get(at) else { return at };
        if !is_of_tests(&group.stream()) {
            self.add(group.stream());
            self.quoted(group.stream());
            return at + 1;
        }
        let items = ["fn", "impl", "struct", "enum", "mod", "use", "const", "static", "trait", "type"];
        let mut is_item = false;
        for (place, token) in tokens.iter().enumerate().skip(at + 1) {
            let text = token.to_string();
            is_item |= items.contains(&&text[..]);
            if text == ";" || (text == "," && !is_item) || is_group(tokens, place, Delimiter::Brace) {
                return place + 1;
            }
        }
        tokens.len()
    }

    /// Adds the paths in the strings of an attribute: `with = "super::text"`.
    fn quoted(&mut self, attribute: TokenStream) {
        for token in attribute {
            match token {
                TokenTree::Group(group) => self.quoted(group.stream()),
                TokenTree::Literal(literal) => {
                    let text = literal.to_string();
                    let path = text.trim_matches('"').split("::").map(str::to_owned).collect::<Names>();
                    let is_name = |name: &String| {
                        matches!(&name[..], "crate" | "self" | "super")
                            || syn::parse_str::<proc_macro2::Ident>(name).is_ok()
                    };
                    if path.len() > 1 && path.iter().all(is_name) {
                        self.paths.insert(path);
                    }
                }
                TokenTree::Ident(_) | TokenTree::Punct(_) => {}
            }
        }
    }
}

/// Returns true if a name is a field, a method, a lifetime, the end of a path, or the name in a function definition.
fn is_part_of_another(tokens: &[TokenTree], at: usize) -> bool {
    let before = |back: usize, sign| at.checked_sub(back).is_some_and(|at| is_sign(tokens, at, sign));
    let is_function =
        at.checked_sub(1).is_some_and(|at| matches!(&tokens[at], TokenTree::Ident(word) if word == "fn"));
    let is_field = before(1, '.') && !before(2, '.');
    is_field || is_function || before(1, '\'') || (before(1, ':') && before(2, ':'))
}

fn is_sign(tokens: &[TokenTree], at: usize, sign: char) -> bool {
    matches!(tokens.get(at), Some(TokenTree::Punct(it)) if it.as_char() == sign)
}

/// Returns true if `::` is at this index.
fn is_joined(tokens: &[TokenTree], at: usize) -> bool {
    is_sign(tokens, at, ':') && is_sign(tokens, at + 1, ':')
}

fn is_group(tokens: &[TokenTree], at: usize, delimiter: Delimiter) -> bool {
    matches!(tokens.get(at), Some(TokenTree::Group(group)) if group.delimiter() == delimiter)
}
