use super::*;
use crate::link::{CLASSIC_MTU, InterfaceCounters};

mod world;

use world::{SimulatedKernel, THERE};

fn interface(name: &str, index: u32, kind: InterfaceKind) -> Interface {
    let mtu = if matches!(kind, InterfaceKind::Other(_)) { 1_500 } else { FD_MTU };
    let (ours, up) = (false, true);
    Interface { index, name: name.to_owned(), kind, ours, up, mtu, counters: InterfaceCounters::default() }
}

fn ours(name: &str, index: u32) -> Interface {
    Interface { ours: true, ..interface(name, index, InterfaceKind::Vcan) }
}

fn kvaser(bitrate: Option<u32>, data_bitrate: Option<u32>) -> CanHardware {
    let driver = Some("kvaser_pci".to_owned());
    CanHardware { driver, bitrate, data_bitrate, fd: data_bitrate.is_some(), ..CanHardware::default() }
}

fn can0(hardware: CanHardware, up: bool) -> Interface {
    let mtu = if hardware.fd { FD_MTU } else { CLASSIC_MTU };
    Interface { up, mtu, ..interface("can0", 4, InterfaceKind::Hardware(hardware)) }
}

fn in_skin(name: &str, format: Format, bitrate: Option<u32>, data_bitrate: Option<u32>) -> InterfaceTarget {
    let rates = HardwareRates { bitrate, data_bitrate };
    let skin = Some(SkinBus { file: "skin.toml".to_owned(), rates });
    InterfaceTarget { name: name.to_owned(), format, skin }
}

fn refused(target: &InterfaceTarget, present: &[Interface]) -> String {
    plan_up(std::slice::from_ref(target), present, false).unwrap_err().to_string()
}

#[test]
fn what_is_missing_is_made_and_a_second_run_has_nothing_to_do() {
    let target = ["vcan0", "vcan1"].map(InterfaceTarget::named);
    let world = SimulatedKernel::of(vec![interface("vcan0", 2, InterfaceKind::Vcan)]);
    let plan = plan_up(&target, &world.here, false).unwrap();
    assert_eq!(plan.steps, [Step { name: "vcan1".into(), action: StepAction::MakeVcan }]);
    assert_eq!(plan.unchanged, ["vcan0 already exists and is suitable (a vcan, made by another program)"]);
    let again = plan_up(&target, &world.carry_out_all(&plan).here, false).unwrap();
    assert_eq!(again.steps, []);
}

#[test]
fn what_is_ours_is_repaired() {
    let narrow = Interface { mtu: CLASSIC_MTU, ..ours("vcan0", 2) };
    let down = Interface { up: false, ..ours("vcan1", 3) };
    let target = ["vcan0", "vcan1"].map(InterfaceTarget::named);
    let plan = plan_up(&target, &[narrow.clone(), down], false).unwrap();
    let said: Vec<_> = plan.steps.iter().map(ToString::to_string).collect();
    let expected = ["take vcan0 down, give it MTU 72 instead of 16, and bring it up", "bring vcan1 up"];
    assert_eq!(said, expected);
    assert_eq!(plan.steps[0].command(), "ip link set vcan0 down && ip link set vcan0 mtu 72 up");
    let classic = in_skin("vcan0", Format::Classic, None, None);
    assert_eq!(plan_up(&[classic], &[narrow], false).unwrap().steps, [], "classic frames fit MTU 16");
}

#[test]
fn a_real_bus_is_never_touched_because_it_was_named() {
    let present = [
        can0(kvaser(Some(500_000), None), false),
        interface("eth0", 2, InterfaceKind::Other("a network interface (ether)".into())),
    ];
    assert_eq!(
        refused(&InterfaceTarget::named("can0"), &present),
        "can0 is CAN hardware (kvaser_pci), which vcan-setup does not change: to check its bit rates, add it \
         to a skin and run `vcan-setup up SKIN.toml`; `vcan-setup status can0` shows them"
    );
    assert_eq!(
        refused(&InterfaceTarget::named("eth0"), &present),
        "eth0 is a network interface (ether), which vcan-setup does not change: choose another name, as in \
         `vcan-setup up vcan0`"
    );
    assert!(
        plan_up(&[InterfaceTarget::named("can0")], &present, true).is_err(),
        "whatever else was asked for"
    );
}

#[test]
fn what_somebody_else_made_is_left_alone_and_the_hint_is_told() {
    let foreign = |mtu, up| Interface { mtu, up, ..interface("vcan0", 2, InterfaceKind::Vcan) };
    assert_eq!(
        refused(&InterfaceTarget::named("vcan0"), &[foreign(16, true)]),
        "vcan0 has MTU 16, but CAN FD needs 72; vcan-setup did not make it and does not change it: `sudo sh \
         -c 'ip link set vcan0 down && ip link set vcan0 mtu 72 up'` fixes it"
    );
    assert_eq!(
        refused(&InterfaceTarget::named("vcan0"), &[foreign(72, false)]),
        "vcan0 is down; vcan-setup did not make it and does not change it: `sudo ip link set vcan0 up` fixes \
         it"
    );
}

#[test]
fn one_bus_that_cannot_be_had_keeps_the_others_from_being_made() {
    let present = [interface("lo", 1, InterfaceKind::Other("the loopback interface".into()))];
    let target = ["vcan0", "lo", "vcan1"].map(InterfaceTarget::named);
    assert!(matches!(plan_up(&target, &present, false), Err(PlanRefusal::NotCan { .. })));
}

#[test]
fn hardware_of_a_skin_is_compared_and_left_as_it_is() {
    let target = in_skin("can0", Format::Fd, Some(1_000_000), Some(5_000_000));
    let right = can0(kvaser(Some(1_000_000), Some(5_000_000)), true);
    let plan = plan_up(std::slice::from_ref(&target), std::slice::from_ref(&right), false).unwrap();
    assert_eq!(plan.steps, []);
    let line = "can0 is CAN hardware (kvaser_pci), runs at 1000 kbit/s, data 5000 kbit/s, as the skin requires, and \
                stays unchanged";
    assert_eq!(plan.unchanged, [line]);
    assert_eq!(plan_up(std::slice::from_ref(&target), &[right], true).unwrap().steps, [], "nor set again");

    let other = [can0(kvaser(Some(500_000), None), true)];
    assert_eq!(
        refused(&target, &other),
        "can0 runs at 500 kbit/s, but skin.toml requires 1000 kbit/s, data 5000 kbit/s: `sudo vcan-setup up skin.toml \
         --set-bit-rates` sets them, or change skin.toml"
    );
    let unset = [can0(kvaser(None, None), false)];
    assert!(
        refused(&target, &unset).starts_with("can0 runs at no bit rate, but skin.toml requires 1000 kbit/s")
    );
    let open = in_skin("can0", Format::Fd, None, None);
    assert_eq!(
        refused(&open, &other),
        "can0 is CAN hardware (kvaser_pci) with MTU 16, but skin.toml has format = \"fd\", which needs 72: \
         `sudo vcan-setup up skin.toml --set-bit-rates` tries CAN FD on it, or set format = \"classic\""
    );
    let classic = CanHardware { fd: false, ..kvaser(Some(1_000_000), Some(5_000_000)) };
    assert!(
        refused(&target, &[can0(classic, true)])
            .starts_with("can0 runs at 1000 kbit/s, but skin.toml requires"),
        "a rate for data that is not in use is none"
    );
    let down = [can0(kvaser(Some(1_000_000), Some(5_000_000)), false)];
    assert_eq!(
        refused(&target, &down),
        "can0 is CAN hardware (kvaser_pci), but down: `sudo vcan-setup up skin.toml --set-bit-rates` sets \
         its bit rates and brings it up"
    );
}

#[test]
fn bit_rates_are_set_only_on_request_and_only_to_what_the_skin_says() {
    let target = in_skin("can0", Format::Fd, Some(1_000_000), Some(5_000_000));
    let present = [can0(kvaser(Some(500_000), None), true)];
    let plan = plan_up(&[target], &present, true).unwrap();
    let [step] = plan.steps.as_slice() else { panic!("{plan:?}") };
    assert_eq!(
        step.to_string(),
        "take can0 down, set can0 to 1000 kbit/s, data 5000 kbit/s instead of 500 kbit/s, and bring it up"
    );
    assert_eq!(
        step.command(),
        "ip link set can0 down && ip link set can0 type can bitrate 1000000 dbitrate 5000000 fd on && ip link \
         set can0 up"
    );
    let set = |target| plan_up(&[target], &present, true).unwrap_err().to_string();
    assert_eq!(
        set(in_skin("can0", Format::Fd, None, None)),
        "skin.toml has no bitrate for can0: put `bitrate = 1000000` under its [[bus]], then try again"
    );
    assert_eq!(
        set(in_skin("can0", Format::Fd, Some(250_000), None)),
        "skin.toml has no data_bitrate for can0: put `data_bitrate = 5000000` under its [[bus]], then try again"
    );
}

#[test]
fn who_goes_from_can_fd_to_classic_switches_it_off() {
    let target = in_skin("can0", Format::Classic, Some(500_000), None);
    let fd = CanHardware { fd: true, ..kvaser(Some(1_000_000), Some(5_000_000)) };
    let plan = plan_up(&[target], &[can0(fd, false)], true).unwrap();
    assert_eq!(
        plan.steps[0].command(),
        "ip link set can0 type can bitrate 500000 fd off && ip link set can0 up"
    );
}

#[test]
fn two_skins_that_give_a_bus_two_bit_rates_are_refused() {
    let skin = |rate| in_skin("can0", Format::Classic, rate, None);
    for set in [false, true] {
        for present in [vec![], vec![can0(kvaser(Some(500_000), None), true)]] {
            let refusal = plan_up(&[skin(Some(500_000)), skin(Some(250_000))], &present, set).unwrap_err();
            assert_eq!(
                refusal.to_string(),
                "two skins differ on the bit rates of can0: skin.toml requires 500 kbit/s, but skin.toml \
                 requires 250 kbit/s; run `vcan-setup up` with one of the skins, or correct one of them"
            );
            assert!(refusal.is_usage());
        }
    }
    let present = [can0(kvaser(Some(500_000), None), true)];
    let both = [skin(Some(500_000)), skin(None), skin(Some(500_000))];
    let plan = plan_up(&both, &present, false).unwrap();
    assert_eq!(plan.steps, []);
    assert_eq!(plan.unchanged.len(), 2, "each line once: {:?}", plan.unchanged);
}

#[test]
fn a_clock_may_miss_a_bit_rate_by_half_a_percent() {
    let met = |has, target| {
        let rates = |bitrate| HardwareRates { bitrate, data_bitrate: None };
        rates(has).matches(rates(target))
    };
    assert!(met(Some(10_000), Some(10_001)) && met(Some(83_333), Some(83_000)));
    assert!(met(Some(995_000), Some(1_000_000)) && !met(Some(994_999), Some(1_000_000)));
    assert!(met(Some(1_005_000), Some(1_000_000)) && !met(Some(1_005_001), Some(1_000_000)));
    assert!(met(None, None) && met(Some(1), None) && !met(None, Some(1)));
}

#[test]
fn a_bus_with_a_bit_rate_is_never_made_of_software() {
    let target = in_skin("can0", Format::Classic, Some(500_000), None);
    assert_eq!(
        refused(&target, &[]),
        "there is no interface can0, and skin.toml gives it a bitrate, so it is hardware: plug it in and \
         load its driver, or remove bitrate to get a vcan"
    );
}

#[test]
fn a_pair_is_made_once_and_told_from_other_pairs() {
    let mut world = SimulatedKernel::of(vec![ours("vcan0", 2)]);
    let named = |there: &SimulatedKernel, id| OtherNamespace {
        name: Namespace::Name("blue".into()),
        id,
        present: there.there.clone(),
    };
    let there = named(&world, None);
    let target = TargetPair { name: "vcan1", peer: "vcan1", there: Some(&there) };
    let plan = plan_pair_up(&target, &world.here).unwrap();
    let [step] = plan.steps.as_slice() else { panic!("{plan:?}") };
    assert_eq!(
        step.command(),
        "ip link add vcan1 mtu 72 type vxcan peer name vcan1 mtu 72 netns blue && ip link set vcan1 alias \
         skinbus up && ip -n blue link set vcan1 alias skinbus up"
    );
    world = world.carry_out_all(&plan);
    let there = named(&world, Some(THERE));
    let again = TargetPair { name: "vcan1", peer: "vcan1", there: Some(&there) };
    assert_eq!(plan_pair_up(&again, &world.here).unwrap().steps, []);

    let elsewhere = named(&world, Some(THERE + 1));
    let other = TargetPair { there: Some(&elsewhere), ..again };
    let error = plan_pair_up(&other, &world.here).unwrap_err().to_string();
    assert_eq!(
        error,
        "vcan1 already exists and is a vxcan, not one end of a pair with vcan1: `sudo vcan-setup down vcan1` \
         removes it, or choose another name"
    );
    let error = plan_pair_up(&TargetPair { name: "vcan5", ..again }, &world.here).unwrap_err().to_string();
    assert_eq!(
        error,
        "vcan1 already exists and is a vxcan in blue, not one end of a pair with vcan5: `sudo ip -n blue link \
         del vcan1` removes it, or choose another name"
    );
    world.there[0].up = false;
    let there = named(&world, Some(THERE));
    let error = plan_pair_up(&TargetPair { there: Some(&there), ..again }, &world.here).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the other end of vcan1, vcan1 in blue, is down; vcan-setup changes nothing in another namespace: `sudo ip -n blue \
         link set vcan1 up` fixes it"
    );
    let same = TargetPair { name: "vcan3", peer: "vcan3", there: None };
    assert!(matches!(plan_pair_up(&same, &world.here), Err(PlanRefusal::OneName { .. })));
}

#[test]
fn only_what_is_ours_is_removed() {
    let present =
        [ours("vcan0", 2), interface("vcan1", 3, InterfaceKind::Vcan), can0(kvaser(None, None), true)];
    let names = ["vcan0", "vcan1", "can0", "vcan9"];
    let skin = names.map(|name| in_skin(name, Format::Fd, None, None));
    let plan = plan_down(&skin, &present).unwrap();
    assert_eq!(plan.steps, [Step { name: "vcan0".into(), action: StepAction::Remove { index: 2 } }]);
    assert_eq!(
        plan.unchanged,
        [
            "vcan1 is a vcan that vcan-setup did not make, so it stays unchanged",
            "can0 is CAN hardware (kvaser_pci) that vcan-setup did not make, so it stays unchanged",
            "vcan9 does not exist",
        ]
    );
    let named = |name| plan_down(&[InterfaceTarget::named(name)], &present);
    assert_eq!(
        named("vcan1").unwrap_err().to_string(),
        "vcan1 is a vcan that vcan-setup did not make, so it stays unchanged: if it is yours, `sudo ip link \
         del vcan1` removes it"
    );
    assert_eq!(
        named("can0").unwrap_err().to_string(),
        "can0 is CAN hardware (kvaser_pci) that vcan-setup did not make, so it stays unchanged"
    );
    assert_eq!(named("vcan9").unwrap().steps, [], "what is not there is removed already");
}

#[test]
fn the_mark_on_something_real_is_not_believed() {
    let mut present = [
        can0(kvaser(None, None), true),
        interface("eth0", 2, InterfaceKind::Other("a network interface (ether)".into())),
    ];
    present.iter_mut().for_each(|it| it.ours = true);
    for name in ["can0", "eth0"] {
        assert!(plan_up(&[InterfaceTarget::named(name)], &present, true).is_err(), "{name}");
        assert!(plan_down(&[InterfaceTarget::named(name)], &present).is_err(), "{name}");
    }
}
