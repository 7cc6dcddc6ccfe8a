//! When cells say what they measure, as a skin's file has it.

use super::raw;
use crate::document::Fault;
use crate::document::Step::{Index, Key};
use crate::fixed::{OutOfRange, Q};
use crate::parameters::{Events, Sensing};

/// Continuous sensing at so many frames a second.
///
/// # Errors
/// What is possible instead: a period is a whole number of ms, 1 to 65 535.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within 1 to 65535")]
pub fn continuous(hz: f64) -> Result<Sensing, String> {
    let period = 1_000.0 / hz;
    if !(hz > 0.0 && (0.999..65_535.5).contains(&period)) {
        return Err("0.0153 to 1000 Hz are possible".to_owned());
    }
    let nearest = period.round().max(1.0);
    if (period - nearest).abs() > 1e-3 * period {
        let (above, below) = (1_000.0 / period.floor(), 1_000.0 / period.ceil());
        return Err(format!(
            "its period must be a whole number of ms; the nearest are {below:.4} and {above:.4} Hz"
        ));
    }
    Ok(Sensing::Continuous { period_ms: nearest as u16 })
}

/// When the cells of a bus say what they measure.
pub(super) fn of_bus(index: usize, bus: &raw::Bus) -> Result<Sensing, Fault> {
    let at = |key| [Key("bus"), Index(index), Key(key)];
    match (bus.sensing.as_deref(), bus.sensing_hz) {
        (Some("continuous"), Some(hz)) => {
            continuous(hz).map_err(|why| Fault::new(&at("sensing_hz"), hz, why))
        }
        (Some("continuous"), None) => {
            Err(Fault::new(&at("sensing"), "\"continuous\"", "sensing_hz is needed with it"))
        }
        (None | Some("off" | "event"), Some(hz)) => {
            Err(Fault::new(&at("sensing_hz"), hz, "only with sensing = \"continuous\""))
        }
        (None | Some("off"), None) => Ok(Sensing::Off),
        (Some("event"), None) => Ok(Sensing::Event),
        (Some(got), _) => {
            Err(Fault::new(&at("sensing"), format!("{got:?}"), "\"off\", \"continuous\" or \"event\""))
        }
    }
}

/// Which changes are events; what is not said is as a cell has it from its start.
pub(super) fn events(raw: raw::Events) -> Result<Events, Fault> {
    fn threshold<const F: u32>(key: &'static str, given: Option<f64>, plain: Q<F>) -> Result<Q<F>, Fault> {
        let Some(value) = given else { return Ok(plain) };
        let path = [Key("events"), Key(key)];
        if value < 0.0 {
            return Err(Fault::new(&path, value, "must not be negative"));
        }
        Q::try_nearest(value).map_err(|OutOfRange { bound, .. }| {
            Fault::new(&path, value, format_args!("its word holds [0, {bound})"))
        })
    }
    let plain = Events::default();
    let hysteresis = threshold("hysteresis", raw.hysteresis, plain.hysteresis)?;
    if let Some(got) = raw.hysteresis.filter(|&part| part > 1.0) {
        let why = "a part of a threshold: 0 to 1 is possible";
        return Err(Fault::new(&[Key("events"), Key("hysteresis")], got, why));
    }
    Ok(Events {
        contact: threshold("contact_n", raw.contact_n, plain.contact)?,
        proximity: threshold("proximity", raw.proximity, plain.proximity)?,
        temperature: threshold("temperature_c", raw.temperature_c, plain.temperature)?,
        acceleration: threshold("acceleration_g", raw.acceleration_g, plain.acceleration)?,
        hysteresis,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_a_period_of_whole_milliseconds() {
        let period = |hz| continuous(hz).map(|sensing| sensing.words()[1].cast_unsigned());
        assert_eq!(
            [62.5, 1_000.0, 1.0, 0.1, 33.333].map(period),
            [Ok(16), Ok(1), Ok(1_000), Ok(10_000), Ok(30)]
        );
        assert_eq!(period(1.0 / 65.535), Ok(65_535));
        for hz in [0.0, -1.0, f64::NAN, f64::INFINITY, 1_100.0, 0.015] {
            assert_eq!(period(hz), Err("0.0153 to 1000 Hz are possible".to_owned()), "{hz}");
        }
        let why = "its period must be a whole number of ms; the nearest are 58.8235 and 62.5000 Hz";
        assert_eq!(period(60.0), Err(why.to_owned()));
    }

    #[test]
    fn explicit_defaults_are_the_defaults() {
        let explicit = raw::Events {
            contact_n: Some(0.1),
            proximity: Some(0.05),
            temperature_c: Some(0.5),
            acceleration_g: Some(0.1),
            hysteresis: Some(0.5),
        };
        assert_eq!(events(explicit).unwrap(), Events::default());
        assert_eq!(events(raw::Events::default()).unwrap(), Events::default());
    }
}
