//! The errors of the sensors in a run: the table `[sensors]`.

use protocol::document::{Checked, KeyPath};
use protocol::fixed::Q9_6;
use protocol::time::Micros;

use super::curve::interpolate;
use super::raw;
use super::times::ScenarioDuration;
use crate::accelerometer::sensor::DataSheet;

/// The reference temperature of data sheet errors, in °C.
pub const REFERENCE_TEMPERATURE_C: f64 = 25.0;

/// The errors of all sensors; the default is perfect sensors. The errors of each cell are drawn with the scenario's
/// seed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SensorErrors {
    /// The temperature of all cells in °C by time, in order of time: linear between the entries, constant before the
    /// first and after the last. If empty, temperature is not simulated.
    pub temperature: Vec<(Micros, f64)>,
    /// The errors of force sensors.
    pub force: ForceErrors,
    /// The data sheet of the cells' accelerometers; `None` for cells without one.
    pub acceleration: Option<DataSheet>,
}

/// The errors of force sensors; zero for perfect ones.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ForceErrors {
    /// The largest zero error in N, of either sign.
    pub offset_n: f64,
    /// The largest relative error of the gain, of either sign.
    pub gain: f64,
    /// The excess of the reading with a falling force over that with a rising one, relative to the force.
    pub hysteresis: f64,
    /// The growth of the reading under a constant force per decade of time, relative to the force.
    pub creep: f64,
    /// The standard deviation of the zero's random walk after an hour, in N.
    pub drift_n: f64,
    /// The largest shift of the zero in N/°C, of either sign.
    pub temperature_n_per_c: f64,
    /// The largest relative change of the gain per °C, of either sign.
    pub temperature_gain_per_c: f64,
    /// The share of the force on a wired neighbour that the sensor reads in addition to its own.
    pub crosstalk: f64,
    /// The standard deviation of the noise in N.
    pub noise_n: f64,
}

impl SensorErrors {
    /// Sensors without errors.
    pub const PERFECT: Self =
        Self { temperature: Vec::new(), force: ForceErrors::PERFECT, acceleration: None };

    /// Returns true if force sensors have no errors and temperature is not simulated.
    #[must_use]
    pub fn is_force_perfect(&self) -> bool {
        self.force == ForceErrors::PERFECT && self.temperature.is_empty()
    }

    /// Returns the temperature of all cells at a time, if it is simulated.
    #[must_use]
    pub fn temperature_at(&self, time: Micros) -> Option<f64> {
        interpolate(&self.temperature, time.0, |Micros(micros)| micros)
    }
}

impl ForceErrors {
    /// Force sensors without errors.
    pub const PERFECT: Self = Self {
        offset_n: 0.0,
        gain: 0.0,
        hysteresis: 0.0,
        creep: 0.0,
        drift_n: 0.0,
        temperature_n_per_c: 0.0,
        temperature_gain_per_c: 0.0,
        crosstalk: 0.0,
        noise_n: 0.0,
    };

    /// Honeywell FSS1500, a piezoresistive bridge of 15 N. Its data sheet gives, at 5 V and 0.12 mV/g: null offset up
    /// to 15 mV, 125 g; sensitivity 0.10 to 0.14 mV/g; null shift 0.5 mV from 25 to 40 °C, 4.2 g; sensitivity shift 5.5
    /// % from 25 to 50 °C.
    pub const PIEZORESISTIVE: Self = Self {
        offset_n: 1.2,
        gain: 0.17,
        temperature_n_per_c: 0.0027,
        temperature_gain_per_c: 0.0022,
        ..Self::PERFECT
    };

    /// Interlink FSR 400, a force sensing resistor. Its data sheet gives: 6 % from part to part; hysteresis 10 %; long
    /// term drift 5 % per log10(time); 15 % less resistance after an hour at 85 °C.
    pub const RESISTIVE: Self =
        Self { gain: 0.06, hysteresis: 0.1, creep: 0.05, temperature_gain_per_c: 0.0025, ..Self::PERFECT };
}

/// Checks the table `[sensors]`.
pub(super) fn check_sensor_errors(raw: &raw::Sensors, end: ScenarioDuration) -> Checked<SensorErrors> {
    let at = KeyPath::top_level_key("sensors");
    let temperature = check_temperature_course(&at.with_key("temperature_c"), &raw.temperature_c, end)?;
    let force = raw
        .force
        .as_ref()
        .map_or(Ok(ForceErrors::PERFECT), |raw| check_force_errors(&at.with_key("force"), raw))?;
    let acceleration =
        raw.acceleration.as_ref().map(|raw| raw.data_sheet(&at.with_key("acceleration"))).transpose()?;
    Ok(SensorErrors { temperature, force, acceleration })
}

fn check_temperature_course(
    at: &KeyPath,
    points: &[[f64; 2]],
    end: ScenarioDuration,
) -> Checked<Vec<(Micros, f64)>> {
    let mut temperature: Vec<(Micros, f64)> = Vec::with_capacity(points.len());
    for (index, &[seconds, degrees]) in points.iter().enumerate() {
        let at = at.with_index(index);
        let moment = end.check_time_up_to_end(&at.with_index(0), seconds)?;
        if temperature.last().is_some_and(|(last, _)| *last >= moment) {
            return Err(at.with_index(0).fault(seconds, "the times must increase"));
        }
        at.with_index(1).to_fixed(degrees, Q9_6::try_nearest)?;
        temperature.push((moment, degrees));
    }
    Ok(temperature)
}

fn check_force_errors(at: &KeyPath, raw: &raw::ForceErrors) -> Checked<ForceErrors> {
    let kinds = [
        ("perfect", ForceErrors::PERFECT),
        ("piezoresistive", ForceErrors::PIEZORESISTIVE),
        ("resistive", ForceErrors::RESISTIVE),
    ];
    let mut errors =
        at.with_key("kind").parse_choice(raw.kind.as_deref().unwrap_or("piezoresistive"), &kinds)?;
    let keys = [
        ("offset_n", raw.offset_n, &mut errors.offset_n, 30.0),
        ("gain", raw.gain, &mut errors.gain, 0.9),
        ("hysteresis", raw.hysteresis, &mut errors.hysteresis, 1.0),
        ("creep", raw.creep, &mut errors.creep, 0.5),
        ("drift_n", raw.drift_n, &mut errors.drift_n, 30.0),
        ("temperature_n_per_c", raw.temperature_n_per_c, &mut errors.temperature_n_per_c, 1.0),
        ("temperature_gain_per_c", raw.temperature_gain_per_c, &mut errors.temperature_gain_per_c, 0.1),
        ("crosstalk", raw.crosstalk, &mut errors.crosstalk, 0.5),
        ("noise_n", raw.noise_n, &mut errors.noise_n, 1.0),
    ];
    for (key, given, error, max) in keys {
        let Some(given) = given else { continue };
        if !(0.0..=max).contains(&given) {
            return Err(at.with_key(key).fault(given, format_args!("must be 0 to {max}")));
        }
        *error = given;
    }
    Ok(errors)
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "these are exact")]
mod tests {
    use super::*;
    use crate::scenario::Scenario;
    use crate::testing::one_cell_skin;

    fn read(text: &str) -> Result<SensorErrors, String> {
        let text = format!("duration_s = 600.0\n{text}");
        Scenario::parse("s.toml", &text, &one_cell_skin())
            .map(|scenario| scenario.sensors)
            .map_err(|error| error.to_string())
    }

    #[test]
    fn sensors_are_perfect_unless_the_scenario_says_how_bad_they_are() {
        for text in ["", "[sensors]\n", "[sensors.force]\nkind = \"perfect\"\n"] {
            assert!(read(text).unwrap().is_force_perfect(), "{text}");
        }
        assert_eq!(read("[sensors.force]\n").unwrap().force, ForceErrors::PIEZORESISTIVE);
        let given =
            read("[sensors.force]\nkind = \"resistive\"\ncreep = 0.0\noffset_n = 0.25\n").unwrap().force;
        assert_eq!(given, ForceErrors { creep: 0.0, offset_n: 0.25, ..ForceErrors::RESISTIVE });
    }

    #[test]
    fn cells_have_accelerometers_if_the_scenario_says_which() {
        assert_eq!(read("[sensors.force]\n").unwrap().acceleration, None);
        assert_eq!(read("[sensors.acceleration]\n").unwrap().acceleration, Some(DataSheet::BMA250));
        let given =
            read("[sensors.acceleration]\nkind = \"perfect\"\nnoise_g = 0.01\n").unwrap().acceleration;
        assert_eq!(given, Some(DataSheet { noise_g: 0.01, ..DataSheet::PERFECT }));
    }

    #[test]
    fn temperature_is_linear_between_its_times() {
        let sensors = read("[sensors]\ntemperature_c = [[60.0, 25.0], [600.0, 35.0]]\n").unwrap();
        let at = |seconds: u64| sensors.temperature_at(Micros(seconds * 1_000_000)).unwrap();
        assert_eq!([0, 60, 330, 600, 700].map(at), [25.0, 25.0, 30.0, 35.0, 35.0]);
        assert_eq!(SensorErrors::PERFECT.temperature_at(Micros(0)), None);
    }

    #[test]
    fn what_cannot_be_is_refused_in_one_line() {
        let cases = [
            (
                "[sensors]\ntemperature_c = [[0.0, 25.0], [0.0, 26.0]]\n",
                "sensors.temperature_c[1][0] = 0: the times must increase",
            ),
            (
                "[sensors]\ntemperature_c = [[601.0, 25.0]]\n",
                "must be within the scenario, from 0 to duration_s = 600",
            ),
            ("[sensors.force]\nkind = \"good\"\n", "\"perfect\", \"piezoresistive\" or \"resistive\""),
            ("[sensors.force]\ngain = 1.0\n", "sensors.force.gain = 1: must be 0 to 0.9"),
            ("[sensors.force]\nnoise_n = nan\n", "sensors.force.noise_n = NaN: must be 0 to 1"),
            ("[sensors.acceleration]\nkind = \"good\"\n", "\"perfect\" or \"bma250\""),
            ("[sensors.acceleration]\nrange_g = 1.0\n", "sensors.acceleration.range_g = 1: must be 1.2 to 8"),
            ("[sensors]\noffset = 1\n", "unknown field `offset`"),
        ];
        for (text, why) in cases {
            let said = read(text).unwrap_err();
            assert!(said.contains(why), "{said}");
        }
    }
}
