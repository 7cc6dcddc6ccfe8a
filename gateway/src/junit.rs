//! Reports in the JUnit format, which CI servers show.

use std::fmt::Write;

use protocol::xml::escaped;

/// A report with its test cases in order.
#[derive(Debug)]
pub(crate) struct TestSuite {
    pub(crate) name: String,
    /// Duration in s.
    pub(crate) seconds: f64,
    pub(crate) cases: Vec<TestCase>,
}

/// A test case of a JUnit report.
#[derive(Debug)]
pub(crate) struct TestCase {
    pub(crate) class: String,
    pub(crate) name: String,
    pub(crate) outcome: Outcome,
}

/// Outcome of a test case.
#[derive(Debug)]
pub(crate) enum Outcome {
    Passed,
    Failed { message: String, text: String },
    Skipped { why: Option<String> },
}

impl TestSuite {
    /// Formats the report as XML.
    pub(crate) fn to_xml(&self) -> String {
        let count = |is: fn(&Outcome) -> bool| self.cases.iter().filter(|case| is(&case.outcome)).count();
        let mut text = format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuite name=\"{}\" tests=\"{}\" failures=\"{}\" \
             skipped=\"{}\" time=\"{:.1}\">\n",
            escaped(&self.name),
            self.cases.len(),
            count(|it| matches!(it, Outcome::Failed { .. })),
            count(|it| matches!(it, Outcome::Skipped { .. })),
            self.seconds,
        );
        for TestCase { class, name, outcome } in &self.cases {
            let (class, name) = (escaped(class), escaped(name));
            let _ = write!(text, "  <testcase classname=\"{class}\" name=\"{name}\"");
            let _ = match outcome {
                Outcome::Passed => writeln!(text, "/>"),
                Outcome::Failed { message, text: more } => writeln!(
                    text,
                    "><failure message=\"{}\">{}</failure></testcase>",
                    escaped(message),
                    escaped(more)
                ),
                Outcome::Skipped { why: Some(why) } => {
                    writeln!(text, "><skipped message=\"{}\"/></testcase>", escaped(why))
                }
                Outcome::Skipped { why: None } => writeln!(text, "><skipped/></testcase>"),
            };
        }
        text + "</testsuite>\n"
    }
}
