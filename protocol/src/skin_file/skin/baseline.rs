//! Checks of the baseline settings for force sensors in a skin file.

use super::raw;
use crate::document::{DocumentFault, KeyPath};
use crate::fixed::{Q1_14, Q5_10};
use crate::parameters::{Baseline, BaselineSettings};

/// Baseline settings for omitted keys.
const DEFAULT_BASELINE_SETTINGS: BaselineSettings = BaselineSettings {
    threshold: Q5_10::from_bits(103),
    hysteresis: Q1_14::from_bits(8_192),
    rate_un_per_s: 2_000,
    limit: Q5_10::from_bits(512),
    n_per_c: Q1_14::ZERO,
};

/// Checks the table `[baseline]` of a skin and returns its settings.
pub(super) fn skin_baseline(raw: Option<raw::RawBaseline>) -> Result<Baseline, DocumentFault> {
    let Some(raw) = raw else { return Ok(Baseline::Off) };
    let at = KeyPath::top_level_key("baseline");
    let modes = [("off", None), ("hold", Some(false)), ("follow", Some(true))];
    let follows = at.with_key("mode").parse_choice(raw.mode.as_deref().unwrap_or("follow"), &modes)?;
    let mut to = DEFAULT_BASELINE_SETTINGS;
    at.with_key("threshold_n").set_fixed_if_given(raw.threshold_n, &mut to.threshold, Q5_10::try_round_up)?;
    if let Some(got) = raw.threshold_n.filter(|_| to.threshold <= Q5_10::ZERO) {
        return Err(at.with_key("threshold_n").fault(got, "must be above 0"));
    }
    at.with_key("hysteresis").set_fixed_if_given(raw.hysteresis, &mut to.hysteresis, Q1_14::try_nearest)?;
    if let Some(got) = raw.hysteresis.filter(|&part| part > 1.0) {
        return Err(at.with_key("hysteresis").fault(got, "must be 0 to 1, as a fraction of the threshold"));
    }
    at.with_key("limit_n").set_fixed_if_given(raw.limit_n, &mut to.limit, Q5_10::try_nearest)?;
    set_temperature_slope(&at.with_key("n_per_c"), raw.n_per_c, &mut to)?;
    if let Some(got) = raw.rate_n_per_s {
        to.rate_un_per_s = to_micronewtons_per_s(got)
            .ok_or_else(|| at.with_key("rate_n_per_s").fault(got, "must be 1e-6 to 0.065535 N/s"))?;
    }
    Ok(match follows {
        None => Baseline::Off,
        Some(true) => Baseline::On(to),
        Some(false) => Baseline::On(BaselineSettings { rate_un_per_s: 0, ..to }),
    })
}

/// Returns the settings of a cell: `base`, with the keys that the cell overrides.
pub(super) fn cell_baseline(
    at: &KeyPath,
    raw: &raw::RawCell,
    base: Baseline,
) -> Result<Baseline, DocumentFault> {
    let Baseline::On(mut to) = base else {
        let given = [("baseline_limit_n", raw.baseline_limit_n), ("baseline_n_per_c", raw.baseline_n_per_c)];
        let given = given.into_iter().find_map(|(key, value)| Some((key, value?)));
        return given.map_or(Ok(base), |(key, value)| {
            Err(at.with_key(key).fault(value, "allowed only with a [baseline] whose mode is not \"off\""))
        });
    };
    at.with_key("baseline_limit_n").set_fixed_if_given(
        raw.baseline_limit_n,
        &mut to.limit,
        Q5_10::try_nearest,
    )?;
    set_temperature_slope(&at.with_key("baseline_n_per_c"), raw.baseline_n_per_c, &mut to)?;
    Ok(Baseline::On(to))
}

/// Sets the drift of the zero with temperature, which may be negative, in N/°C.
fn set_temperature_slope(
    at: &KeyPath,
    given: Option<f64>,
    to: &mut BaselineSettings,
) -> Result<(), DocumentFault> {
    if let Some(given) = given {
        to.n_per_c = at.to_fixed(given, Q1_14::try_nearest)?;
    }
    Ok(())
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within 1 to 65535")]
fn to_micronewtons_per_s(n_per_s: f64) -> Option<u16> {
    let rate = (n_per_s * 1e6).round();
    (1.0..=65_535.0).contains(&rate).then_some(rate as u16)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::skin::Skin;

    const HEAD: &str = "[robot]\njoints = [{ d = 0.1 }, { a = 0.5 }]\n";
    const CELL: &str =
        "[[cell]]\nnode = 1\njoint = 2\nposition = [0.1, 0.0, 0.1]\nnormal = [0.0, 0.0, 1.0]\n";

    fn read(baseline: &str, cell: &str) -> Result<Baseline, String> {
        let text = format!("{HEAD}{baseline}\n{CELL}{cell}\n");
        Skin::parse("skin.toml", &text)
            .map(|skin| skin.cells.first().map(|cell| cell.baseline).unwrap())
            .map_err(|error| error.to_string())
    }

    #[test]
    fn cells_have_no_baseline_unless_the_skin_has() {
        assert_eq!(read("", ""), Ok(Baseline::Off));
        assert_eq!(read("[baseline]\nmode = \"off\"\nlimit_n = 1.0", ""), Ok(Baseline::Off));
        assert_eq!(read("[baseline]", ""), Ok(Baseline::On(DEFAULT_BASELINE_SETTINGS)));
        let hold = BaselineSettings { rate_un_per_s: 0, ..DEFAULT_BASELINE_SETTINGS };
        assert_eq!(read("[baseline]\nmode = \"hold\"", ""), Ok(Baseline::On(hold)));
        let said = "threshold_n = 0.1\nhysteresis = 0.5\nrate_n_per_s = 0.002\nlimit_n = 0.5\nn_per_c = 0.0";
        assert_eq!(
            read(&format!("[baseline]\n{said}"), ""),
            Ok(Baseline::On(DEFAULT_BASELINE_SETTINGS)),
            "the defaults"
        );
    }

    #[test]
    fn a_cell_overrides_limit_and_slope() {
        let own = BaselineSettings {
            limit: Q5_10::nearest(1.5),
            n_per_c: Q1_14::nearest(-0.02),
            ..DEFAULT_BASELINE_SETTINGS
        };
        let cell = "baseline_limit_n = 1.5\nbaseline_n_per_c = -0.02";
        assert_eq!(read("[baseline]", cell), Ok(Baseline::On(own)));
        let why = read("", cell).unwrap_err();
        assert!(
            why.ends_with("baseline_limit_n = 1.5: allowed only with a [baseline] whose mode is not \"off\""),
            "{why}"
        );
    }

    #[test]
    fn what_cannot_be_is_refused_in_one_line() {
        for (key, why) in [
            ("mode = \"on\"", "baseline.mode = \"on\": must be \"off\", \"hold\" or \"follow\""),
            ("threshold_n = 0.0", "baseline.threshold_n = 0: must be above 0"),
            ("limit_n = -1.0", "baseline.limit_n = -1: must not be negative"),
            ("hysteresis = 1.5", "baseline.hysteresis = 1.5: must be 0 to 1, as a fraction of the threshold"),
            ("rate_n_per_s = 0.0", "baseline.rate_n_per_s = 0: must be 1e-6 to 0.065535 N/s"),
            ("rate_n_per_s = 0.1", "baseline.rate_n_per_s = 0.1: must be 1e-6 to 0.065535 N/s"),
        ] {
            let said = read(&format!("[baseline]\n{key}"), "").unwrap_err();
            assert!(said.ends_with(why), "{said}");
        }
    }
}
