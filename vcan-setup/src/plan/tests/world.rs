//! Checks properties that every plan must have, by executing plans in a simulation of the kernel's interfaces.

use proptest::prelude::*;

use super::*;
use crate::link::Peer;

/// A simulation of the kernel's interfaces. A step on an interface that this program did not make fails the test.
#[derive(Clone, Debug, Eq, PartialEq)]
pub(super) struct SimulatedKernel {
    pub(super) here: Vec<Interface>,
    pub(super) there: Vec<Interface>,
}

pub(super) const THERE: i32 = 7;

impl SimulatedKernel {
    pub(super) fn of(here: Vec<Interface>) -> Self {
        Self { here, there: Vec::new() }
    }

    fn named(&self, name: &str) -> &Interface {
        find_interface(&self.here, name).unwrap_or_else(|| panic!("{name} is there: {self:?}"))
    }

    fn by_number(&mut self, index: u32, name: &str) -> &mut Interface {
        let found = self.here.iter_mut().find(|it| it.index == index).expect("a number that is there");
        assert_eq!(found.name, name);
        found
    }

    fn ours(&mut self, index: u32, name: &str) -> &mut Interface {
        let found = self.by_number(index, name);
        assert!(found.ours && found.is_virtual(), "not ours: {found:?}");
        found
    }

    fn carry_out(&mut self, step: &Step) {
        let next = |all: &[Interface]| all.iter().map(|it| it.index).max().unwrap_or(0) + 1;
        let Step { name, action } = step;
        match action {
            StepAction::MakeVcan => {
                assert!(find_interface(&self.here, name).is_none(), "{name} is there already");
                self.here.push(ours(name, next(&self.here)));
            }
            StepAction::MakePair { peer, namespace } => {
                let first = next(&self.here);
                let (id, back, second) = match namespace {
                    None => (None, None, first + 1),
                    Some(_) => (Some(THERE), Some(0), next(&self.there)),
                };
                let end = |name: &str, index, peer_index, peer: &str, namespace_id| {
                    let peer = Peer { name: Some(peer.to_owned()), namespace_id, ..number(peer_index) };
                    Interface { ours: true, ..interface(name, index, InterfaceKind::Vxcan(Some(peer))) }
                };
                assert!(find_interface(&self.here, name).is_none(), "{name} is there already");
                self.here.push(end(name, first, second, peer, id));
                let others = if namespace.is_some() { &mut self.there } else { &mut self.here };
                assert!(find_interface(others, peer).is_none(), "{peer} is there already");
                others.push(end(peer, second, first, name, back));
            }
            StepAction::BringUp { index } => self.ours(*index, name).up = true,
            StepAction::Widen { index, from, was_up } => {
                let found = self.ours(*index, name);
                assert_eq!((found.mtu, found.up), (*from, *was_up));
                (found.mtu, found.up) = (FD_MTU, true);
            }
            StepAction::SetRates { index, rates, before, was_up } => {
                let found = self.by_number(*index, name);
                assert_eq!(found.up, *was_up);
                let InterfaceKind::Hardware(hardware) = &mut found.kind else {
                    panic!("no hardware: {found:?}")
                };
                assert_eq!(hardware.bit_rates(), *before);
                (hardware.bitrate, hardware.data_bitrate) = (rates.bitrate, rates.data_bitrate);
                hardware.fd = rates.data_bitrate.is_some();
                found.mtu = if hardware.fd { FD_MTU } else { CLASSIC_MTU };
                found.up = true;
            }
            StepAction::Remove { index } => {
                let removed = self.ours(*index, name).clone();
                let peer = removed.peer().filter(|peer| peer.namespace_id.is_none()).map(|peer| peer.index);
                self.here.retain(|it| it.index != *index && Some(it.index) != peer);
            }
        }
    }

    pub(super) fn carry_out_all(&self, plan: &Plan) -> Self {
        let mut after = self.clone();
        plan.steps.iter().for_each(|step| after.carry_out(step));
        after
    }
}

/// Returns the other end of a pair as an interface of this namespace with this index.
fn number(index: u32) -> Peer {
    Peer { index, name: None, namespace: None, namespace_id: None }
}

const NAMES: [&str; 5] = ["vcan0", "vcan1", "vcan2", "can0", "eth0"];

/// Generates interfaces with distinct names, two of which may be the ends of a pair.
fn any_world() -> impl Strategy<Value = SimulatedKernel> {
    let one = (0..5_u8, any::<bool>(), any::<bool>(), any::<bool>(), 0..3_u32, 0..3_u32);
    (proptest::collection::vec(proptest::option::of(one), NAMES.len()), any::<bool>()).prop_map(
        |(given, pair)| {
            let mut here = Vec::new();
            for ((name, given), index) in NAMES.into_iter().zip(given).zip(2..) {
                let Some((kind, ours, up, wide, rate, data)) = given else { continue };
                let kind = match kind {
                    0 | 1 => InterfaceKind::Vcan,
                    2 => InterfaceKind::Vxcan(None),
                    3 => InterfaceKind::Hardware(kvaser(
                        (rate > 0).then_some(rate * 250_000),
                        (rate > 0 && data > 0).then_some(data * 1_000_000),
                    )),
                    _ => InterfaceKind::Other("a network interface (ether)".to_owned()),
                };
                let mtu = if wide { FD_MTU } else { CLASSIC_MTU };
                here.push(Interface { ours, up, mtu, ..interface(name, index, kind) });
            }
            if let (true, [first, second, ..]) = (pair, here.as_mut_slice()) {
                let to = |it: &Interface| number(it.index);
                let kinds = (InterfaceKind::Vxcan(Some(to(second))), InterfaceKind::Vxcan(Some(to(first))));
                (first.kind, second.kind) = kinds;
            }
            SimulatedKernel::of(here)
        },
    )
}

fn any_target() -> impl Strategy<Value = Vec<InterfaceTarget>> {
    let one = (0..NAMES.len(), any::<bool>(), any::<bool>(), 0..3_u32, 0..3_u32);
    let target = one.prop_map(|(name, skin, fd, rate, data)| {
        let name = NAMES[name];
        if !skin {
            return InterfaceTarget::named(name);
        }
        let format = if fd { Format::Fd } else { Format::Classic };
        let bitrate = (rate > 0).then_some(rate * 250_000);
        let data = (rate > 0 && data > 0 && fd).then_some(data * 1_000_000);
        in_skin(name, format, bitrate, data)
    });
    // Each interface is named once, because two skins may contradict each other.
    proptest::collection::vec(target, 0..5).prop_map(|mut all| {
        let mut seen = std::collections::HashSet::new();
        all.retain(|target| seen.insert(target.name.clone()));
        all
    })
}

proptest! {
    #[test]
    fn a_plan_leads_to_what_is_requested_and_touches_nothing_else(
        world in any_world(), target in any_target(), set: bool,
    ) {
        let Ok(plan) = plan_up(&target, &world.here, set) else {
            let harmless = |target: &InterfaceTarget| find_interface(&world.here, &target.name)
                .map_or_else(|| target.hardware().is_none(), |it| it.is_virtual() && it.ours);
            prop_assert!(!target.iter().all(harmless), "refused, and all could have been had");
            return Ok(());
        };
        let after = world.carry_out_all(&plan);
        for target in &target {
            let it = after.named(&target.name);
            prop_assert!(it.is_can() && it.up && target.fits_mtu(it.mtu), "{it:?}");
        }
        for before in &world.here {
            let hardware = matches!(before.kind, InterfaceKind::Hardware(_));
            let may_change = target.iter().any(|it| it.name == before.name)
                && (before.is_virtual() && before.ours || hardware && set);
            prop_assert!(may_change || after.named(&before.name) == before, "{before:?}");
        }
        prop_assert_eq!(plan_up(&target, &after.here, set).unwrap().steps, []);
        prop_assert_eq!(plan_up(&target, &after.here, false).unwrap().steps, []);
    }

    #[test]
    fn down_takes_back_what_up_made(world in any_world(), target in any_target()) {
        let Ok(plan) = plan_up(&target, &world.here, false) else { return Ok(()) };
        let after = world.carry_out_all(&plan);
        let made: Vec<_> = plan.steps.iter().map(|step| InterfaceTarget::named(&step.name)).collect();
        let end = after.carry_out_all(&plan_down(&made, &after.here).unwrap());
        let kept = |it: &&Interface| plan.steps.iter().all(|step| step.name != it.name);
        for before in world.here.iter().filter(kept) {
            let taken_along = before.peer().is_some_and(|peer| peer.namespace_id.is_none());
            prop_assert!(taken_along || end.named(&before.name) == before);
        }
        prop_assert!(made.iter().all(|target| find_interface(&end.here, &target.name).is_none()));
    }

    #[test]
    fn down_removes_what_is_ours_and_only_that(world in any_world(), target in any_target()) {
        let Ok(plan) = plan_down(&target, &world.here) else {
            let foreign = |target: &InterfaceTarget| find_interface(&world.here, &target.name)
                .is_some_and(|it| !it.ours || !it.is_virtual());
            prop_assert!(target.iter().any(|target| target.skin.is_none() && foreign(target)));
            return Ok(());
        };
        let after = world.carry_out_all(&plan);
        for target in &target {
            let unchanged = find_interface(&after.here, &target.name);
            prop_assert!(unchanged.is_none_or(|it| !it.ours || !it.is_virtual()), "{unchanged:?}");
        }
        prop_assert_eq!(plan_down(&target, &after.here).unwrap().steps, []);
    }
}
