//! Options of a stimulus for the sensors pages other than the skin's, from the fields of the schema.

use clap::{Arg, ArgMatches, Args, Command, Error, FromArgMatches};
use model::decode::parameter;
use protocol::id::Kind;
use protocol::packet::WORDS;
use protocol::schema::{Field, Layout, packet_schemas};

/// Options of the page of the skin, which exclude all others.
const SKIN_PAGE_OPTIONS: [&str; 3] = ["force", "proximity", "temperature"];

/// The values of one page.
#[derive(Clone, Debug, Default)]
pub(super) struct OtherPageOptions {
    /// Each given field, with its texts.
    given: Vec<(&'static Layout, &'static Field, Vec<String>)>,
}

/// Returns the layouts of the pages that a stimulus sets.
pub(super) fn stimulus_layouts() -> impl Iterator<Item = &'static Layout> {
    packet_schemas().iter().filter(|schema| schema.kind == Kind::Stimulus).flat_map(|schema| &schema.layouts)
}

/// Returns the fields of the pages other than the skin's.
fn page_fields() -> impl Iterator<Item = (&'static Layout, &'static Field)> {
    let others = stimulus_layouts().filter(|layout| layout.number != 0);
    others.flat_map(|layout| layout.fields.iter().map(move |field| (layout, field)))
}

impl OtherPageOptions {
    /// Returns the number and the words of the page, if one is given.
    pub(super) fn given_page(&self) -> Result<Option<(u8, [i16; WORDS])>, String> {
        let Some((layout, ..)) = self.given.first() else { return Ok(None) };
        let mut words = [0; WORDS];
        for (_, field, texts) in &self.given {
            for (word, text) in words.iter_mut().skip(field.first_bit() / 16).zip(texts) {
                let read = parameter::parse_finite(text).and_then(|_| parameter::parse_value(field, text));
                *word =
                    read.map_err(|allowed| format!("--{} {text}: {allowed}", field.name_without_unit()))?;
            }
        }
        Ok(Some((layout.number, words)))
    }
}

impl FromArgMatches for OtherPageOptions {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, Error> {
        let texts = |field: &Field| {
            let texts = matches.get_many::<String>(field.name_without_unit())?;
            Some(texts.cloned().collect())
        };
        let given = page_fields().filter_map(|(layout, field)| Some((layout, field, texts(field)?)));
        Ok(Self { given: given.collect() })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

impl Args for OtherPageOptions {
    fn augment_args(command: Command) -> Command {
        page_fields().fold(command, |command, (layout, field)| {
            let name = field.name_without_unit();
            let (first, rest) = name.split_at(name.chars().next().map_or(0, char::len_utf8));
            // The names last as long as the program, as clap requires.
            let labels: Vec<&'static str> = match field.labels.as_slice() {
                [] => vec![first.to_uppercase().leak()],
                labels => labels.iter().map(|label| &*label.to_uppercase().leak()).collect(),
            };
            let unit = if field.unit.is_empty() { String::new() } else { format!(" in {}", field.unit) };
            let pages = page_fields().filter(|(other, _)| other.number != layout.number);
            command.arg(
                Arg::new(name)
                    .long(name)
                    .num_args(field.element_count())
                    .value_names(labels)
                    .allow_negative_numbers(true)
                    .conflicts_with_all(
                        SKIN_PAGE_OPTIONS
                            .into_iter()
                            .chain(pages.map(|(_, field)| field.name_without_unit())),
                    )
                    .help(format!(
                        "{}{rest}{unit}; replaces the force and the proximity",
                        first.to_uppercase()
                    )),
            )
        })
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}
