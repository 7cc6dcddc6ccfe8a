//! Units and resolution of the words in joints, torques and sums, which depend on the bus.

use core::f64::consts::FRAC_PI_2;

use super::{Field, FieldFormat};
use crate::fixed::TorqueFormat;
use crate::skin::{JointKind, Skin};

/// The properties of a bus on which units depend: the torque format, and which joints of the chain are prismatic. The
/// default is Q3.12 and revolute joints only.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct BusUnits {
    torque: TorqueFormat,
    /// Bit j is set if joint j + 1 is prismatic.
    prismatic: u16,
}

impl BusUnits {
    /// Returns the units of a bus, given as an index into [`Skin::buses`].
    #[must_use]
    pub fn for_bus(skin: &Skin, bus: usize) -> Self {
        let torque = skin.buses.get(bus).map(|bus| bus.torque_format).unwrap_or_default();
        let is_prismatic = |kind| u16::from(kind == JointKind::Prismatic);
        let bits = skin.joints_on_bus(bus).zip(0..16).map(|((_, joint), at)| is_prismatic(joint.kind) << at);
        Self { torque, prismatic: bits.fold(0, |all, bit| all | bit) }
    }

    /// Returns the torque format of the cells.
    #[must_use]
    pub const fn torque_format(self) -> TorqueFormat {
        self.torque
    }

    /// Returns the unit of a joint's torque: Nm, or N for a prismatic joint. `joint` is the index in the chain, from 0.
    #[must_use]
    pub const fn torque_unit(self, joint: usize) -> &'static str {
        if self.has_prismatic_joint(joint) {
            JointKind::Prismatic.torque_unit()
        } else {
            JointKind::Revolute.torque_unit()
        }
    }

    const fn has_prismatic_joint(self, joint: usize) -> bool {
        joint < 16 && self.prismatic >> joint & 1 == 1
    }

    /// Returns true if the element of the field is the position or torque of a prismatic joint.
    fn is_prismatic(self, field: &Field, element: usize) -> bool {
        field.varies_with_chain() && self.has_prismatic_joint(element)
    }
}

impl Field {
    /// Returns the value of one step of an element, in the unit [`Self::element_unit`].
    #[must_use]
    pub fn element_step_size(&self, element: usize, units: BusUnits) -> f64 {
        let step = 1.0 / f64::from(1_u32 << self.fraction_bits());
        if self.format == FieldFormat::Torque {
            units.torque.step_size()
        } else if self.format == FieldFormat::Angle
            || self.format == FieldFormat::Position && !units.is_prismatic(self, element)
        {
            step * FRAC_PI_2
        } else {
            step
        }
    }

    /// Converts the raw value of an element to the unit [`Self::element_unit`].
    #[must_use]
    pub fn element_value(&self, raw: i64, element: usize, units: BusUnits) -> f64 {
        f64::from(i16::try_from(raw).unwrap_or_default()) * self.element_step_size(element, units)
    }

    /// Converts a raw value to the unit of the field, for fields whose unit is the same on every bus.
    #[must_use]
    pub fn raw_to_real(&self, raw: i64) -> f64 {
        self.element_value(raw, 0, BusUnits::default())
    }

    /// Returns the unit of an element: that of the field, but m or N if the element belongs to a prismatic joint.
    #[must_use]
    pub fn element_unit(&self, element: usize, units: BusUnits) -> &str {
        let (turns, slides) = (JointKind::Revolute, JointKind::Prismatic);
        match self.unit.as_str() {
            unit if !units.is_prismatic(self, element) => unit,
            unit if unit == turns.unit() => slides.unit(),
            unit if unit == turns.torque_unit() => slides.torque_unit(),
            unit => unit,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schema::packet_schemas;

    #[test]
    fn what_grows_with_the_chain_has_the_unit_of_its_joint() {
        let units = BusUnits { prismatic: 0b10, ..BusUnits::default() };
        let fields =
            || packet_schemas().iter().flat_map(|packet| packet.layouts.iter().flat_map(|it| &it.fields));
        let positions = fields().find(|field| field.format == FieldFormat::Position).unwrap();
        assert_eq!([0, 1, 2].map(|joint| positions.element_unit(joint, units)), ["rad", "m", "rad"]);
        let torques = fields().find(|field| field.format == FieldFormat::Torque).unwrap();
        assert_eq!([0, 1].map(|joint| torques.element_unit(joint, units)), ["Nm", "N"]);
        assert_eq!([0, 1].map(|joint| torques.element_unit(joint, BusUnits::default())), ["Nm", "Nm"]);
    }

    #[test]
    #[expect(clippy::float_cmp, reason = "multiples of powers of two")]
    fn a_raw_value_is_a_multiple_of_the_step_of_its_unit() {
        let fields =
            || packet_schemas().iter().flat_map(|packet| packet.layouts.iter().flat_map(|it| &it.fields));
        let units = BusUnits { prismatic: 0b10, ..BusUnits::default() };
        let torques = fields().find(|field| field.format == FieldFormat::Torque).unwrap();
        assert_eq!([-4_096, 0, 2_048].map(|raw| torques.element_value(raw, 0, units)), [-1.0, 0.0, 0.5]);
        let positions = fields().find(|field| field.format == FieldFormat::Position).unwrap();
        let at = |joint| positions.element_value(1 << 14, joint, units);
        assert_eq!([0, 1].map(at), [FRAC_PI_2, 1.0], "an angle in quarter turns, and m");
    }
}
