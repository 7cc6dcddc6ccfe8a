//! The page's files.

/// What is served under a path: its type and its bytes.
pub(crate) fn file(path: &str) -> Option<(&'static str, &'static [u8])> {
    const SCRIPT: &str = "text/javascript; charset=utf-8";
    Some(match path {
        "/" => ("text/html; charset=utf-8", include_bytes!("../web/index.html")),
        "/style.css" => ("text/css; charset=utf-8", include_bytes!("../web/style.css")),
        "/app.js" => (SCRIPT, include_bytes!("../web/app.js")),
        "/bench.js" => (SCRIPT, include_bytes!("../web/bench.js")),
        "/math.js" => (SCRIPT, include_bytes!("../web/math.js")),
        "/robot.js" => (SCRIPT, include_bytes!("../web/robot.js")),
        "/picture.js" => (SCRIPT, include_bytes!("../web/picture.js")),
        "/camera.js" => (SCRIPT, include_bytes!("../web/camera.js")),
        "/gl.js" => (SCRIPT, include_bytes!("../web/gl.js")),
        "/pace.js" => (SCRIPT, include_bytes!("../web/pace.js")),
        "/colours.js" => (SCRIPT, include_bytes!("../web/colours.js")),
        "/plots.js" => (SCRIPT, include_bytes!("../web/plots.js")),
        "/wires.js" => (SCRIPT, include_bytes!("../web/wires.js")),
        "/words.js" => (SCRIPT, include_bytes!("../web/words.js")),
        "/touch.js" => (SCRIPT, include_bytes!("../web/touch.js")),
        "/dom.js" => (SCRIPT, include_bytes!("../web/dom.js")),
        "/time.js" => (SCRIPT, include_bytes!("../web/time.js")),
        "/halted.js" => (SCRIPT, include_bytes!("../web/halted.js")),
        "/frames.js" => (SCRIPT, include_bytes!("../web/frames.js")),
        "/link.js" => (SCRIPT, include_bytes!("../web/link.js")),
        _ => return None,
    })
}

/// Checks that a file is a script or a style: the same for everybody, with nothing about the bench.
pub(crate) fn is_code(path: &str) -> bool {
    path != "/" && file(path).is_some()
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILES: [&str; 20] = [
        "/",
        "/style.css",
        "/app.js",
        "/bench.js",
        "/math.js",
        "/robot.js",
        "/picture.js",
        "/camera.js",
        "/gl.js",
        "/pace.js",
        "/colours.js",
        "/plots.js",
        "/wires.js",
        "/words.js",
        "/touch.js",
        "/dom.js",
        "/time.js",
        "/frames.js",
        "/halted.js",
        "/link.js",
    ];

    #[test]
    fn the_page_is_small_and_asks_for_nothing_outside() {
        let mut bytes = 0;
        for path in FILES {
            let (_, content) = file(path).unwrap();
            let text = str::from_utf8(content).unwrap();
            assert!(!text.contains("http:") && !text.contains("https:") && !text.contains("//cdn"), "{path}");
            assert!(!text.contains("innerHTML") && !text.contains("eval("), "{path}");
            bytes += content.len();
            for (_, import) in text.match_indices("from \"./").map(|(at, _)| (at, &text[at + 8..])) {
                let name = import.split('"').next().unwrap();
                assert!(FILES.contains(&format!("/{name}").as_str()), "{path} imports {name}");
            }
        }
        assert!(bytes <= 200_000, "{bytes}");
        assert_eq!(file("/../Cargo.toml"), None);
    }
}
