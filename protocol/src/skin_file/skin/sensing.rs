//! Checks of the sensing modes of buses in a skin file.

use super::raw;
use crate::document::{DocumentFault, KeyPath};
use crate::fixed::{OutOfRange, Q};
use crate::parameters::{Events, Sensing};

/// Returns the setting for measurements at a frequency in Hz.
///
/// # Errors
/// Returns a text with the allowed frequencies: the period must be a whole number of ms, 1 to 65 535.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within 1 to 65535")]
pub fn continuous_sensing(hz: f64) -> Result<Sensing, String> {
    let period = 1_000.0 / hz;
    if !(hz > 0.0 && (0.999..65_535.5).contains(&period)) {
        return Err("must be 0.0153 to 1000 Hz".to_owned());
    }
    let nearest = period.round().max(1.0);
    if (period - nearest).abs() > 1e-3 * period {
        let (above, below) = (1_000.0 / period.floor(), 1_000.0 / period.ceil());
        return Err(format!(
            "its period must be a whole number of ms; the nearest rates are {below:.4} and {above:.4} Hz"
        ));
    }
    Ok(Sensing::Continuous { period_ms: nearest as u16 })
}

/// Checks the sensing mode of a bus.
pub(super) fn bus_sensing(at: &KeyPath, bus: &raw::RawBus) -> Result<Sensing, DocumentFault> {
    /// The values of the key `mode`.
    #[derive(Clone, Copy)]
    enum SensingModeName {
        Off,
        Continuous,
        Event,
    }
    let words = [
        ("off", SensingModeName::Off),
        ("continuous", SensingModeName::Continuous),
        ("event", SensingModeName::Event),
    ];
    let mode = at.with_key("sensing").parse_choice(bus.sensing.as_deref().unwrap_or("off"), &words)?;
    match (mode, bus.sensing_hz) {
        (SensingModeName::Continuous, Some(hz)) => {
            continuous_sensing(hz).map_err(|why| at.with_key("sensing_hz").fault(hz, why))
        }
        (SensingModeName::Continuous, None) => {
            Err(at.with_key("sensing").fault("\"continuous\"", "this mode needs the key sensing_hz too"))
        }
        (SensingModeName::Off | SensingModeName::Event, Some(hz)) => {
            Err(at.with_key("sensing_hz").fault(hz, "allowed only with sensing = \"continuous\""))
        }
        (SensingModeName::Off, None) => Ok(Sensing::Off),
        (SensingModeName::Event, None) => Ok(Sensing::Event),
    }
}

/// Checks the thresholds of event mode. An omitted value is the default of a cell.
pub(super) fn check_events(raw: raw::RawEvents) -> Result<Events, DocumentFault> {
    /// Rounds a threshold to a word. An error gives 0 as the lower limit, because a threshold is not negative.
    fn round_threshold<const F: u32>(value: f64) -> Result<Q<F>, OutOfRange> {
        Q::try_nearest(value).map_err(|error| OutOfRange { min: 0.0, ..error })
    }
    let at = KeyPath::top_level_key("events");
    let mut events = Events::default();
    at.with_key("hysteresis").set_fixed_if_given(raw.hysteresis, &mut events.hysteresis, round_threshold)?;
    if let Some(got) = raw.hysteresis.filter(|&part| part > 1.0) {
        return Err(at.with_key("hysteresis").fault(got, "must be 0 to 1, as a fraction of each threshold"));
    }
    at.with_key("contact_n").set_fixed_if_given(raw.contact_n, &mut events.contact, round_threshold)?;
    at.with_key("proximity").set_fixed_if_given(raw.proximity, &mut events.proximity, round_threshold)?;
    at.with_key("temperature_c").set_fixed_if_given(
        raw.temperature_c,
        &mut events.temperature,
        round_threshold,
    )?;
    at.with_key("acceleration_g").set_fixed_if_given(
        raw.acceleration_g,
        &mut events.acceleration,
        round_threshold,
    )?;
    Ok(events)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_a_period_of_whole_milliseconds() {
        let period = |hz| continuous_sensing(hz).map(|sensing| sensing.words()[1].cast_unsigned());
        assert_eq!(
            [62.5, 1_000.0, 1.0, 0.1, 33.333].map(period),
            [Ok(16), Ok(1), Ok(1_000), Ok(10_000), Ok(30)]
        );
        assert_eq!(period(1.0 / 65.535), Ok(65_535));
        for hz in [0.0, -1.0, f64::NAN, f64::INFINITY, 1_100.0, 0.015] {
            assert_eq!(period(hz), Err("must be 0.0153 to 1000 Hz".to_owned()), "{hz}");
        }
        let why = "its period must be a whole number of ms; the nearest rates are 58.8235 and 62.5000 Hz";
        assert_eq!(period(60.0), Err(why.to_owned()));
    }

    #[test]
    fn explicit_defaults_are_the_defaults() {
        let explicit = raw::RawEvents {
            contact_n: Some(0.1),
            proximity: Some(0.05),
            temperature_c: Some(0.5),
            acceleration_g: Some(0.1),
            hysteresis: Some(0.5),
        };
        assert_eq!(check_events(explicit).unwrap(), Events::default());
        assert_eq!(check_events(raw::RawEvents::default()).unwrap(), Events::default());
    }
}
