//! The files of the pages. They are served one by one, or bundled into one script for a page without a server.

/// The files of the live page, and of the page that shows a skin without buses.
const WEB_FILES: [(&str, &str); 34] = [
    ("index.html", include_str!("../web/index.html")),
    ("still.html", include_str!("../web/still.html")),
    ("style.css", include_str!("../web/style.css")),
    ("app.js", include_str!("../web/app.js")),
    ("arrows.js", include_str!("../web/arrows.js")),
    ("bench.js", include_str!("../web/bench.js")),
    ("camera.js", include_str!("../web/camera.js")),
    ("colours.js", include_str!("../web/colours.js")),
    ("curves.js", include_str!("../web/curves.js")),
    ("dom.js", include_str!("../web/dom.js")),
    ("events.js", include_str!("../web/events.js")),
    ("frames.js", include_str!("../web/frames.js")),
    ("gl.js", include_str!("../web/gl.js")),
    ("ground.js", include_str!("../web/ground.js")),
    ("halted.js", include_str!("../web/halted.js")),
    ("health.js", include_str!("../web/health.js")),
    ("lane.js", include_str!("../web/lane.js")),
    ("legend.js", include_str!("../web/legend.js")),
    ("link.js", include_str!("../web/link.js")),
    ("math.js", include_str!("../web/math.js")),
    ("numbers.js", include_str!("../web/numbers.js")),
    ("pace.js", include_str!("../web/pace.js")),
    ("picture.js", include_str!("../web/picture.js")),
    ("plots.js", include_str!("../web/plots.js")),
    ("robot.js", include_str!("../web/robot.js")),
    ("scale.js", include_str!("../web/scale.js")),
    ("snapshot.js", include_str!("../web/snapshot.js")),
    ("state.js", include_str!("../web/state.js")),
    ("still.js", include_str!("../web/still.js")),
    ("strip.js", include_str!("../web/strip.js")),
    ("time.js", include_str!("../web/time.js")),
    ("touch.js", include_str!("../web/touch.js")),
    ("wires.js", include_str!("../web/wires.js")),
    ("words.js", include_str!("../web/words.js")),
];

/// Returns the text of the file with this name.
pub(crate) fn file_text(name: &str) -> Option<&'static str> {
    WEB_FILES.iter().find(|(known, _)| *known == name).map(|(_, text)| *text)
}

/// Returns the media type and the contents of the file at a path of the server.
pub(crate) fn media_type_and_contents(path: &str) -> Option<(&'static str, &'static [u8])> {
    let name = if path == "/" { "index.html" } else { path.strip_prefix('/')? };
    let kind = match name.rsplit_once('.')? {
        (_, "js") => "text/javascript; charset=utf-8",
        (_, "css") => "text/css; charset=utf-8",
        _ if path == "/" => "text/html; charset=utf-8",
        _ => return None,
    };
    file_text(name).map(|text| (kind, text.as_bytes()))
}

/// Returns true if the path is that of a script or a style. These are the same for every client and reveal nothing
/// about the bench.
pub(crate) fn is_script_or_style(path: &str) -> bool {
    path != "/" && media_type_and_contents(path).is_some()
}

/// Bundles a module and all modules that it imports into one script. Each module becomes a function, defined after
/// those that it imports.
///
/// Supports only the syntax of the files here: an import is on one line, and a declaration follows `export`.
pub(crate) fn bundle_modules(entry: &'static str) -> String {
    let mut script = String::from("\"use strict\";\nconst modules = {};\n");
    add_module(entry, &mut Vec::new(), &mut script);
    script
}

fn add_module(name: &'static str, added: &mut Vec<&'static str>, script: &mut String) {
    if added.contains(&name) {
        return;
    }
    added.push(name);
    let Some(text) = file_text(name) else { return };
    let (mut body, mut exported) = (String::new(), Vec::new());
    for line in text.lines() {
        if let Some((names, from)) = parse_import(line) {
            add_module(from, added, script);
            let names =
                names.strip_prefix("* as ").map_or_else(|| names.replace(" as ", ": "), str::to_owned);
            body.push_str(&format!("const {names} = modules[\"{from}\"];"));
        } else if let Some(declaration) = line.strip_prefix("export ") {
            exported.extend(declared_names(declaration));
            body.push_str(declaration);
        } else {
            body.push_str(line);
        }
        body.push('\n');
    }
    let exported = exported.join(", ");
    script.push_str(&format!("modules[\"{name}\"] = (() => {{\n{body}return {{ {exported} }};\n}})();\n"));
}

/// Returns the imported names and the file of an import line; `None` for another line.
fn parse_import(line: &'static str) -> Option<(&'static str, &'static str)> {
    let (names, from) = line.strip_prefix("import ")?.split_once(" from \"./")?;
    Some((names, from.strip_suffix("\";")?))
}

/// Returns the names that a declaration introduces: a function, a class, a constant, or constants in brackets.
fn declared_names(declaration: &str) -> Vec<&str> {
    let Some((_, rest)) = declaration.split_once(' ') else { return Vec::new() };
    let is_of_name = |letter: char| letter.is_ascii_alphanumeric() || letter == '_';
    match rest.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((names, _)) => names.split(", ").collect(),
        None => rest.split(|letter| !is_of_name(letter)).take(1).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_is_small_and_asks_for_nothing_outside() {
        let mut bytes = 0;
        for (name, text) in WEB_FILES {
            assert!(!text.contains("http:") && !text.contains("https:") && !text.contains("//cdn"), "{name}");
            assert!(!text.contains("innerHTML") && !text.contains("eval("), "{name}");
            assert!(text.lines().count() <= 500, "{name}");
            bytes += text.len();
            for line in text.lines().filter(|line| line.starts_with("import ")) {
                let (_, from) = parse_import(line).unwrap_or_else(|| panic!("{name}: {line}"));
                assert!(file_text(from).is_some(), "{name} imports {from}");
            }
        }
        assert!(bytes <= 200_000, "{bytes}");
        for (path, is_served) in [
            ("/", true),
            ("/app.js", true),
            ("/style.css", true),
            ("/index.html", false),
            ("/still.html", false),
            ("/../Cargo.toml", false),
            ("app.js", false),
            ("//", false),
        ] {
            assert_eq!(media_type_and_contents(path).is_some(), is_served, "{path}");
        }
    }

    #[test]
    fn a_bundle_has_each_module_once_behind_those_that_it_imports() {
        for entry in ["still.js", "app.js"] {
            let script = bundle_modules(entry);
            assert!(!script.lines().any(|line| line.starts_with("import ") || line.starts_with("export ")));
            assert!(!script.contains("</script"), "it would end the element that it is in");
            let place = |name: &str| script.find(&format!("modules[\"{name}\"] = (() =>"));
            for (name, text) in WEB_FILES.into_iter().filter(|(name, _)| place(name).is_some()) {
                assert_eq!(script.matches(&format!("modules[\"{name}\"] = (() =>")).count(), 1, "{name}");
                for (names, from) in text.lines().filter_map(parse_import) {
                    assert!(place(from).unwrap() < place(name).unwrap(), "{name} before {from}");
                    let exported = WEB_FILES.iter().find(|(known, _)| *known == from).unwrap().1.lines();
                    let exported: Vec<_> = exported
                        .filter_map(|line| line.strip_prefix("export "))
                        .flat_map(declared_names)
                        .collect();
                    let names = names.trim_matches(|letter| "{} ".contains(letter)).split(", ");
                    for name in names.filter(|name| !name.starts_with('*')) {
                        let name = name.split(" as ").next().unwrap();
                        assert!(exported.contains(&name), "{from} has no {name}");
                    }
                }
            }
        }
        assert_eq!(declared_names("const [TREE, CUT] = [0, 1];"), ["TREE", "CUT"]);
        assert_eq!(declared_names("function table(rows) {"), ["table"]);
    }
}
