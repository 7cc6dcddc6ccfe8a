//! Checks the touches of a scenario's file.

use protocol::document::{Checked, KeyPath, span_from_seconds};
use protocol::time::Span;

use super::force::MAX_FORCE_N;
use super::names::{CellSelection, NameTable};
use super::times::{MAX_DURATION_S, ScenarioDuration, check_duration};
use super::{ForceProfile, Touch, TouchValues, raw};

/// Checks the touches; returns them in the file's order.
pub(super) fn check_touches(
    raw: &[raw::Touch],
    end: ScenarioDuration,
    names: &NameTable<'_>,
) -> Checked<Vec<Touch>> {
    let mut touches = Vec::with_capacity(raw.len());
    for (index, raw) in raw.iter().enumerate() {
        let at = KeyPath::top_level_key("touch").with_index(index);
        touches.push(check_touch(&at, raw, end, names)?);
        check_total_force(&at, &touches, names)?;
    }
    Ok(touches)
}

fn check_touch(
    at: &KeyPath,
    raw: &raw::Touch,
    end: ScenarioDuration,
    names: &NameTable<'_>,
) -> Checked<Touch> {
    let (profile, length, force_n) = match &raw.profile {
        raw::TouchProfile::Word(word) => profile_from_name(at, raw, word)?,
        raw::TouchProfile::Points(points) => profile_from_points(at, raw, points)?,
    };
    let values = TouchValues::check(at, raw)?;
    let given = CellSelection { at, bus: raw.bus.as_deref(), cells: raw.cells.as_deref(), all: raw.all };
    Ok(Touch {
        at: end.check_time_before_end(&at.with_key("at_s"), raw.at_s)?,
        length,
        cells: names.cells(given)?,
        force_n,
        profile,
        values,
    })
}

/// Returns the profile that a touch names with a word, the duration of the touch, and its peak force in N.
fn profile_from_name(at: &KeyPath, raw: &raw::Touch, word: &str) -> Checked<(ForceProfile, Span, f64)> {
    let profiles = [ForceProfile::HalfSine, ForceProfile::Step, ForceProfile::Ramp]
        .map(|profile| (profile.name(), profile));
    let Some((_, profile)) = profiles.iter().find(|(name, _)| *name == word).cloned() else {
        let words = profiles.map(|(name, _)| format!("{name:?}")).join(", ");
        let why = format!("must be {words} or points [[t_s, force_n], ...]");
        return Err(at.with_key("profile").fault(format_args!("{word:?}"), why));
    };
    let at_force = at.with_key("force_n");
    let Some(force_n) = raw.force_n else {
        return Err(at_force.fault("", format_args!("required with profile = {word:?}")));
    };
    check_force(&at_force, force_n)?;
    let length = match (raw.for_s, &profile) {
        (Some(seconds), _) => check_duration(&at.with_key("for_s"), seconds)?,
        (None, ForceProfile::Step) => Span(u64::MAX),
        (None, ForceProfile::HalfSine | ForceProfile::Ramp | ForceProfile::Points(_)) => {
            return Err(at.with_key("for_s").fault("", format_args!("required with profile = {word:?}")));
        }
    };
    Ok((profile, length, force_n))
}

/// Returns the profile that a touch gives as points, the duration of the touch, and its peak force in N.
fn profile_from_points(
    at: &KeyPath,
    raw: &raw::Touch,
    given: &[Vec<f64>],
) -> Checked<(ForceProfile, Span, f64)> {
    let path = at.with_key("profile");
    let mut points: Vec<(Span, f64)> = Vec::with_capacity(given.len() + 1);
    let mut peak_n = 0.0_f64;
    for (index, given) in given.iter().enumerate() {
        let point = path.with_index(index);
        let &[seconds, force_n] = given.as_slice() else {
            let why = format_args!("a point must be two numbers [t_s, force_n], not {}", given.len());
            return Err(point.fault("", why));
        };
        if !(0.0..=MAX_DURATION_S).contains(&seconds) {
            let why = format!("must be 0 to {MAX_DURATION_S:e} s after the start of the touch");
            return Err(point.with_index(0).fault(seconds, why));
        }
        let moment = span_from_seconds(seconds);
        if points.last().is_some_and(|(last, _)| *last >= moment) {
            let why = "the times of points must increase, by at least 1e-6 s";
            return Err(point.with_index(0).fault(seconds, why));
        }
        check_force(&point.with_index(1), force_n)?;
        if points.is_empty() && moment > Span(0) {
            points.push((Span(0), 0.0));
        }
        points.push((moment, force_n));
        peak_n = peak_n.max(force_n);
    }
    let Some(&(length, _)) = points.last().filter(|(last, _)| *last > Span(0)) else {
        let got = if given.is_empty() { "[]" } else { "" };
        return Err(
            path.fault(got, "the last point [t_s, force_n] is the end of the touch: its t_s must be above 0")
        );
    };
    if let Some(for_s) =
        raw.for_s.filter(|seconds| !(*seconds >= 0.0 && span_from_seconds(*seconds) == length))
    {
        let why = format!("the points of the profile end at {} s: omit for_s", length.seconds());
        return Err(at.with_key("for_s").fault(for_s, why));
    }
    #[expect(clippy::float_cmp, reason = "two numbers of the same file")]
    if let Some(force_n) = raw.force_n.filter(|force_n| *force_n != peak_n) {
        let why = format!("the largest force of the profile's points is {peak_n} N: omit force_n");
        return Err(at.with_key("force_n").fault(force_n, why));
    }
    Ok((ForceProfile::Points(points), length, peak_n))
}

/// Checks that a force fits three contact words.
fn check_force(at: &KeyPath, force_n: f64) -> Checked<()> {
    if (0.0..=MAX_FORCE_N).contains(&force_n) {
        return Ok(());
    }
    let why =
        format!("must be 0 to {MAX_FORCE_N:.3} N, the most that a cell's three contact sensors can report");
    Err(at.fault(force_n, why))
}

/// Checks that the forces of simultaneous touches together fit the contact words of every cell. `touches` ends with the
/// touch to check; those before it in the file have passed. The check adds peak forces at the start of each touch,
/// where the number of simultaneous touches is largest.
fn check_total_force(at: &KeyPath, touches: &[Touch], names: &NameTable<'_>) -> Checked<()> {
    let Some((last, before)) = touches.split_last() else { return Ok(()) };
    for start in touches.iter().map(|touch| touch.at).filter(|&at| last.is_active_at(at)) {
        let at_once: Vec<&Touch> = before.iter().filter(|touch| touch.is_active_at(start)).collect();
        if at_once.is_empty() {
            continue;
        }
        for cell in &last.cells {
            let others = at_once.iter().filter(|touch| touch.cells.binary_search(cell).is_ok());
            let force = last.force_n + others.map(|touch| touch.force_n).sum::<f64>();
            if force > MAX_FORCE_N {
                let why = format!(
                    "together with earlier touches this makes {force} N on {}, more than the \
                     {MAX_FORCE_N:.3} N of three contact words",
                    names.name(*cell)
                );
                return Err(match last.profile {
                    ForceProfile::Points(_) => {
                        at.with_key("profile").fault(format_args!("up to {} N", last.force_n), why)
                    }
                    ForceProfile::HalfSine | ForceProfile::Step | ForceProfile::Ramp => {
                        at.with_key("force_n").fault(last.force_n, why)
                    }
                });
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use protocol::time::Micros;

    use super::*;
    use crate::scenario::{Scenario, Touches, contact_words};
    use crate::testing::one_cell_skin;

    fn read(touch: &str) -> Result<Scenario, String> {
        let text = format!("[[touch]]\nat_s = 1.0\ncells = [1]\n{touch}\n");
        Scenario::parse("s.toml", &text, &one_cell_skin()).map_err(|error| error.to_string())
    }

    fn one(touch: &str) -> Touch {
        read(touch).unwrap().touches.remove(0)
    }

    #[test]
    fn a_profile_of_points_is_linear_between_them_and_ends_at_the_last_one() {
        let touch = one("profile = [[0.0, 2.0], [0.5, 4], [1.0, 1.0]]");
        assert_eq!((touch.length, touch.force_n), (Span(1_000_000), 4.0));
        let at = |micros: u64| touch.force_at(Micros(1_000_000 + micros));
        assert_eq!([0, 250_000, 500_000, 750_000].map(at), [2.0, 3.0, 4.0, 2.5].map(Some));
        assert_eq!((touch.force_at(Micros(999_999)), at(1_000_000)), (None, None));
        assert!((at(999_999).unwrap() - 1.0).abs() < 1e-4);
        let later = one("profile = [[0.5, 3.0]]");
        assert_eq!(
            later.profile,
            ForceProfile::Points(vec![(Span(0), 0.0), (Span(500_000), 3.0)]),
            "from 0 N"
        );
        let same = one("profile = [[0.0, 2.0], [0.5, 4], [1.0, 1.0]]\nfor_s = 1.0\nforce_n = 4.0");
        assert_eq!(same, touch, "keys that agree");
        let flat = read("profile = [[0.0, 3.0], [20.0, 3.0]]").unwrap();
        assert_eq!(flat.duration, Span(22_000_000), "a second after the last point");
        let step = read("for_s = 20.0\nforce_n = 3.0").unwrap();
        let words = |scenario: &Scenario| {
            let touches = Touches::new(scenario, &one_cell_skin());
            (0..1_400).map(|epoch| touches.sensors(0, epoch)).collect::<Vec<_>>()
        };
        assert_eq!(words(&flat), words(&step));
        assert_eq!(words(&flat)[100].contact, contact_words(3.0));
    }

    #[test]
    fn what_a_profile_cannot_be_is_refused_with_its_place() {
        for (touch, said) in [
            (
                "profile = []",
                "4:11: touch[0].profile = []: the last point [t_s, force_n] is the end of the touch",
            ),
            ("profile = [[0.0, 3.0]]", "4:11: touch[0].profile: the last point [t_s, force_n] is the end"),
            (
                "profile = [[1.0, 3.0], [0.5, 2.0]]",
                "4:25: touch[0].profile[1][0] = 0.5: the times of points must increase",
            ),
            (
                "profile = [[1.0, 3.0], [1.0, 2.0]]",
                "4:25: touch[0].profile[1][0] = 1: the times of points must increase",
            ),
            ("profile = [[-1.0, 3.0]]", "4:13: touch[0].profile[0][0] = -1: must be 0 to 3.2e7 s after"),
            ("profile = [[nan, 3.0]]", "4:13: touch[0].profile[0][0] = NaN: must be 0 to 3.2e7 s"),
            ("profile = [[1.0, 96.0]]", "4:18: touch[0].profile[0][1] = 96: must be 0 to 95.997 N"),
            ("profile = [[1.0, -0.5]]", "4:18: touch[0].profile[0][1] = -0.5: must be 0 to 95.997 N"),
            ("profile = [[1.0, nan]]", "4:18: touch[0].profile[0][1] = NaN: must be 0 to 95.997 N"),
            (
                "profile = [[1.0, 3.0, 2.0]]",
                "4:12: touch[0].profile[0]: a point must be two numbers [t_s, force_n], not 3",
            ),
            ("profile = [[1.0, \"3 N\"]]", "4:18: touch[0].profile[0][1] = \"3 N\": must be a number"),
            (
                "profile = [[1.0, 3.0], [2.0]]",
                "4:24: touch[0].profile[1]: a point must be two numbers [t_s, force_n], not 1",
            ),
            ("profile = [1.0, 3.0]", "touch[0].profile[0] = 1.0: must be a list of values in brackets"),
            (
                "profile = 3.0",
                "4:11: touch[0].profile = 3.0: must be either a word in quotes or a list of points [[t_s, \
                 force_n], ...]",
            ),
            (
                "profile = [[1.0, 3.0]]\nfor_s = 2.0",
                "5:9: touch[0].for_s = 2: the points of the profile end at 1 s: omit for_s",
            ),
            (
                "force_n = 2.0\nprofile = [[1.0, 3.0]]",
                "4:11: touch[0].force_n = 2: the largest force of the profile's points is 3 N: omit force_n",
            ),
            ("", "1:1: touch[0].force_n: required with profile = \"step\""),
            ("force_n = 3.0\nprofile = \"poke\"", "\"ramp\" or points [[t_s, force_n], ...]"),
            (
                "profile = [[1.0, 90.0]]\n[[touch]]\nall = true\nprofile = [[2.0, 7.0]]",
                "7:11: touch[1].profile = up to 7 N: together with earlier touches this makes 97 N on cell 1",
            ),
        ] {
            let got = read(touch).unwrap_err();
            assert!(got.contains(said), "{touch}\n{got}");
        }
    }

    #[test]
    fn a_profile_below_the_thresholds_is_remarked() {
        let remarks = read("profile = [[1.0, 0.01]]").unwrap().warnings(&one_cell_skin());
        let said = "the touch at 1 s: the largest force of its profile, 0.01 N, is below the thresholds of its cells";
        assert!(remarks[0].starts_with(said), "{remarks:?}");
    }

    /// Generates points in order of time, at least 1 ms apart.
    fn points() -> impl Strategy<Value = Vec<(u64, f64)>> {
        let steps = proptest::collection::vec((1_000_u64..2_000_000, 0.0..MAX_FORCE_N), 1..12);
        (any::<bool>(), steps).prop_map(|(from_zero, steps)| {
            let mut at = 0;
            let each = steps.into_iter().enumerate().map(|(index, (step, force_n))| {
                at += if index == 0 && from_zero { 0 } else { step };
                (at, force_n)
            });
            each.collect()
        })
    }

    fn written(points: &[(u64, f64)]) -> String {
        let each = points.iter().map(|(at, force_n)| format!("[{}, {force_n:?}]", Span(*at).seconds()));
        format!("profile = [{}]", each.collect::<Vec<_>>().join(", "))
    }

    proptest! {
        #[test]
        fn a_profile_stays_between_its_points_and_holds_until_the_last_one(
            points in points(),
            parts in proptest::collection::vec(0.0_f64..1.2, 1..40),
        ) {
            let end = points.last().unwrap().0;
            prop_assume!(end > 0);
            let touch = one(&written(&points));
            prop_assert_eq!(touch.length, Span(end));
            let at = |since: u64| touch.force_at(Micros(1_000_000 + since));
            for &(moment, force_n) in points.iter().filter(|(moment, _)| *moment < end) {
                prop_assert_eq!(at(moment), Some(force_n), "at a point, its force");
            }
            for part in parts {
                let since = span_from_seconds(part * Span(end).seconds()).0;
                let level = at(since);
                prop_assert_eq!(level.is_some(), since < end);
                let Some(level) = level else { continue };
                let after = points.iter().find(|(moment, _)| *moment > since).unwrap();
                let before = points.iter().rev().find(|(moment, _)| *moment <= since);
                let before = before.map_or(0.0, |(_, force_n)| *force_n);
                prop_assert!(level >= before.min(after.1) - 1e-9 && level <= before.max(after.1) + 1e-9);
                prop_assert!(level <= touch.force_n + 1e-9);
            }
        }

        #[test]
        fn no_profile_panics(points in proptest::collection::vec((any::<f64>(), any::<f64>()), 0..4)) {
            let each = points.iter().map(|(at, force_n)| format!("[{at:?}, {force_n:?}]").replace("NaN", "nan"));
            let _ = read(&format!("profile = [{}]", each.collect::<Vec<_>>().join(", ")));
        }
    }
}
