//! Checks a scenario's file against one skin.

use core::f64::consts::TAU;

use protocol::document::{Checked, KeyPath};
use protocol::skin::{MAX_ROBOT_JOINTS, Skin};
use protocol::time::Span;

use super::names::NameTable;
use super::times::{ScenarioDuration, check_duration};
use super::{ModeChange, Motion, MotionKind, Scenario, TorqueSource, Touch, faults, pressed, raw, sensors};

pub(super) fn scenario(raw: raw::Scenario, skin: &Skin) -> Checked<Scenario> {
    if raw.version != 1 {
        return Err(KeyPath::top_level_key("version").fault(raw.version, "this program reads version 1"));
    }
    let end = ScenarioDuration(raw.duration_s());
    let duration = check_duration(&KeyPath::top_level_key("duration_s"), end.0)?;
    let negative = |_| KeyPath::top_level_key("seed").fault(raw.seed, "must not be negative");
    let seed = u64::try_from(raw.seed).map_err(negative)?;
    let motion = motion(&raw.motion, skin)?;
    let modes = modes(&raw.mode, end)?;
    let names = NameTable::new(skin);
    let touches = pressed::check_touches(&raw.touch, end, &names)?;
    let touches_repeat =
        raw.touches_repeat_s.map(|seconds| check_repeat(&raw.touch, &touches, seconds)).transpose()?;
    let faults = faults::faults(&raw.fault, end, &names)?;
    let sensors = sensors::check_sensor_errors(&raw.sensors, end)?;
    Ok(Scenario { duration, seed, motion, modes, touches, touches_repeat, faults, sensors })
}

fn motion(raw: &raw::Motion, skin: &Skin) -> Checked<Motion> {
    let at = KeyPath::top_level_key("motion");
    let robot = &skin.robot;
    let joints = |key, values: &[f64]| {
        if values.len() != robot.joints.len() {
            let why = format!("must have one value for each of the robot's {} joints", robot.joints.len());
            return Err(at.with_key(key).fault(format_args!("{} values", values.len()), why));
        }
        Ok(core::array::from_fn(|joint| values.get(joint).copied().unwrap_or(0.0)))
    };
    let (start_key, start) = value_or_former_key(&at, ("start", &raw.start), ("start_rad", &raw.start_rad))?;
    // The value in range nearest to zero.
    let mut nearest = [0.0; MAX_ROBOT_JOINTS];
    for (start, joint) in nearest.iter_mut().zip(&robot.joints) {
        *start = f64::clamp(0.0, joint.limits[0], joint.limits[1]);
    }
    let start = start.map_or(Ok(nearest), |it| joints(start_key, it))?;
    let (key, amplitude) =
        value_or_former_key(&at, ("amplitude", &raw.amplitude), ("amplitude_rad", &raw.amplitude_rad))?;
    let kinds =
        [("hold", Some(MotionKind::Hold)), ("sine", None), ("kinesthetic", Some(MotionKind::Kinesthetic))];
    let needed = "required with kind = \"sine\"";
    let only = "allowed only with kind = \"sine\"";
    let (kind, reach) = match (at.with_key("kind").parse_choice(&raw.kind, &kinds)?, amplitude, raw.period_s)
    {
        (Some(kind), None, None) => (kind, [0.0; MAX_ROBOT_JOINTS]),
        (Some(_), Some(_), _) => return Err(at.with_key(key).fault("", only)),
        (Some(_), None, Some(got)) => return Err(at.with_key("period_s").fault(got, only)),
        (None, None, _) => return Err(at.with_key(key).fault("", needed)),
        (None, Some(_), None) => return Err(at.with_key("period_s").fault("", needed)),
        (None, Some(amplitude), Some(period_s)) => {
            let amplitude = joints(key, amplitude)?;
            check_duration(&at.with_key("period_s"), period_s)?;
            check_speeds(&at.with_key(key), skin, &amplitude, period_s)?;
            (MotionKind::Sine { amplitude, period_s }, amplitude.map(f64::abs))
        }
    };
    for (index, ((start, reach), joint)) in start.iter().zip(reach).zip(&robot.joints).enumerate() {
        let ([min, max], unit) = (joint.limits, joint.kind.unit());
        // This form refuses NaN, too.
        if !(start - reach >= min && start + reach <= max) {
            let swings =
                if reach > 0.0 { format!(", and it swings by {reach} {unit}") } else { String::new() };
            let why = format!("{} is limited to {min:.4} to {max:.4} {unit}{swings}", joint.name);
            return Err(at.with_key(start_key).with_index(index).fault(format_args!("{start} {unit}"), why));
        }
    }
    Ok(Motion { start, kind })
}

/// Returns the value under a key or under the key's former name, with the name that the file uses.
fn value_or_former_key<'a, T>(
    at: &KeyPath,
    (key, value): (&'static str, &'a Option<T>),
    (former, given): (&'static str, &'a Option<T>),
) -> Checked<(&'static str, Option<&'a T>)> {
    match (value, given) {
        (Some(_), Some(_)) => {
            Err(at.with_key(former).fault("", format_args!("is the former name of {key}: use only one")))
        }
        (None, Some(given)) => Ok((former, Some(given))),
        (value, None) => Ok((key, value.as_ref())),
    }
}

/// Checks that no joint exceeds its speed limit. A swinging joint is fastest at the start of the motion.
fn check_speeds(
    at: &KeyPath,
    skin: &Skin,
    amplitude: &[f64; MAX_ROBOT_JOINTS],
    period_s: f64,
) -> Checked<()> {
    let limits = skin.controller.max_speed.iter().zip(&skin.robot.joints);
    for (index, (amplitude, (&max, joint))) in amplitude.iter().zip(limits).enumerate() {
        let (speed, unit) = (TAU * amplitude.abs() / period_s, joint.kind.unit());
        if speed.is_nan() || speed > max {
            let why = format!(
                "with a period of {period_s} s this needs {speed:.3} {unit}/s, but the limit of joint {} is {max}",
                index + 1
            );
            return Err(at.with_index(index).fault(amplitude, why));
        }
    }
    Ok(())
}

fn modes(raw: &[raw::Mode], end: ScenarioDuration) -> Checked<Vec<ModeChange>> {
    let mut modes: Vec<ModeChange> = Vec::with_capacity(raw.len());
    for (index, raw) in raw.iter().enumerate() {
        let path = KeyPath::top_level_key("mode").with_index(index);
        let at = end.check_time_before_end(&path.with_key("at_s"), raw.at_s)?;
        if modes.last().is_some_and(|last| last.at >= at) {
            return Err(path.with_key("at_s").fault(raw.at_s, "modes must be in the order of their times"));
        }
        let kinds = [TorqueSource::Compare, TorqueSource::Distributed].map(|mode| (mode.name(), mode));
        modes.push(ModeChange { at, mode: path.with_key("kind").parse_choice(&raw.kind, &kinds)? });
    }
    Ok(modes)
}

/// Checks the period of the touches: each touch must end before all begin again.
fn check_repeat(raw: &[raw::Touch], touches: &[Touch], seconds: f64) -> Checked<Span> {
    let period = check_duration(&KeyPath::top_level_key("touches_repeat_s"), seconds)?;
    for (index, (raw, touch)) in raw.iter().zip(touches).enumerate() {
        // A touch without a length must begin within the period.
        let lasts = if touch.length == Span(u64::MAX) { 0 } else { touch.length.0 };
        if touch.at.0.saturating_add(lasts) > period.0 || touch.at.0 >= period.0 {
            let key = if raw.for_s.is_some() { "for_s" } else { "at_s" };
            let got = raw.for_s.unwrap_or(raw.at_s);
            let why =
                format_args!("the touch must end before all touches repeat at touches_repeat_s = {seconds}");
            return Err(KeyPath::top_level_key("touch").with_index(index).with_key(key).fault(got, why));
        }
    }
    Ok(period)
}
