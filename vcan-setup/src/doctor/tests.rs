use super::*;
use crate::kernel::ModuleState;
use crate::link::{
    CLASSIC_MTU, CanHardware, ControllerState, FD_MTU, HardwareRates, Interface, InterfaceCounters,
    InterfaceKind,
};
use crate::plan::SkinBus;

fn interface(name: &str, kind: InterfaceKind) -> Interface {
    let counters = InterfaceCounters::default();
    Interface { index: 2, name: name.to_owned(), kind, ours: true, up: true, mtu: FD_MTU, counters }
}

fn cell(node: i64) -> CellId {
    CellId::new(node).unwrap()
}

/// Returns a bus of a skin with 100 cells.
fn bus(interface: Option<Interface>) -> BusFacts {
    let name = interface.as_ref().map_or("vcan0", |it| it.name.as_str()).to_owned();
    let skin = Some(SkinBus { file: "skin.toml".into(), rates: HardwareRates::default() });
    BusFacts {
        target: InterfaceTarget { name, format: Format::Fd, skin },
        cells: Some((1..=100).map(cell).collect()),
        sums: false,
        traffic: Ok(interface.as_ref().map(|_| ObservedTraffic::default())),
        interface,
    }
}

/// Returns the facts of a machine without faults.
fn good() -> MachineFacts {
    MachineFacts {
        choice: KindChoice::Auto,
        no_spawn: false,
        program: "vcan-setup".into(),
        kernel: Kernel {
            release: "6.1.0".into(),
            machine: "x86_64".into(),
            distribution: "debian".into(),
            has_can: true,
            can_raw: ModuleState::Available,
            vcan: ModuleState::Available,
            vxcan: ModuleState::Available,
        },
        user: User { root: false, admin: false },
        receive_buffer: Some(2 << 20),
        backlog: Some(1_000),
        cell_node: Program { path: "/bin/cell-node".into(), there: true },
        embedded: Ok("/run/skinbus".into()),
        buses: vec![bus(Some(interface("vcan0", InterfaceKind::Vcan)))],
        present: vec![interface("vcan0", InterfaceKind::Vcan)],
    }
}

fn no_can(choice: KindChoice) -> MachineFacts {
    let mut facts = MachineFacts { choice, ..good() };
    facts.kernel.has_can = false;
    facts.kernel.can_raw = ModuleState::Loadable;
    facts.buses = vec![bus(None)];
    facts
}

/// Returns all findings as printed, except those that are ok.
fn complaints(facts: &MachineFacts) -> Vec<String> {
    let bad = |finding: Finding| {
        let hints = finding.hints.iter().map(|hint| format!(" | {hint}")).collect::<String>();
        (finding.level != FindingLevel::Ok)
            .then(|| format!("{}: {}{hints}", finding.level.name(), finding.text))
    };
    assess_machine(facts).into_iter().filter_map(bad).collect()
}

/// Changes the facts of a machine without faults, and returns the findings.
fn about(change: impl FnOnce(&mut MachineFacts)) -> Vec<String> {
    let mut facts = good();
    change(&mut facts);
    let said = complaints(&facts);
    assert_eq!(
        would_bench_run(&assess_machine(&facts)),
        !said.iter().any(|line| line.starts_with("fault")),
        "{said:?}"
    );
    said
}

fn about_interface(change: impl FnOnce(&mut Interface)) -> Vec<String> {
    about(|facts| change(facts.buses[0].interface.as_mut().unwrap()))
}

fn about_hardware(
    target: impl FnOnce(&mut InterfaceTarget),
    change: impl FnOnce(&mut Interface, &mut CanHardware),
) -> Vec<String> {
    about(|facts| {
        let mut hardware = CanHardware {
            driver: Some("kvaser_pci".into()),
            bitrate: Some(1_000_000),
            data_bitrate: Some(5_000_000),
            fd: true,
            listen_only: false,
            state: Some(ControllerState::ErrorActive),
        };
        let mut can0 = interface("can0", InterfaceKind::Vcan);
        can0.ours = false;
        change(&mut can0, &mut hardware);
        can0.kind = InterfaceKind::Hardware(hardware);
        let mut can0 = bus(Some(can0));
        if let Some(skin) = &mut can0.target.skin {
            skin.rates = HardwareRates { bitrate: Some(1_000_000), data_bitrate: Some(5_000_000) };
        }
        target(&mut can0.target);
        facts.buses = vec![can0];
    })
}

fn listens(heard: ObservedTraffic, no_spawn: bool) -> Vec<String> {
    about(|facts| {
        facts.no_spawn = no_spawn;
        facts.buses[0].traffic = Ok(Some(heard));
    })
}

fn cells(nodes: impl IntoIterator<Item = i64>) -> ObservedTraffic {
    ObservedTraffic { gateway: false, cells: nodes.into_iter().map(cell).collect() }
}

#[test]
fn a_machine_on_which_all_is_well() {
    assert_eq!(complaints(&good()), Vec::<String>::new());
    assert!(assess_machine(&good()).len() > 4, "and says what it looked at");
}

#[test]
fn no_can_in_the_kernel_matters_by_what_was_chosen() {
    assert_eq!(
        complaints(&no_can(KindChoice::Auto)),
        ["note: the kernel (6.1.0) does not support CAN, so the bench uses the embedded bus, without \
             candump and real cells; to get a kernel with CAN: | sudo modprobe -a can_raw vcan vxcan | \
             tests/lab/run COMMAND  # in the project's folder: runs COMMAND in a virtual machine that has \
             vcan"]
    );
    assert_eq!(no_can(KindChoice::Auto).bus_kind(), BusKind::Embedded);
    assert_eq!(complaints(&no_can(KindChoice::Only(BusKind::Embedded))), Vec::<String>::new());
    let only = complaints(&no_can(KindChoice::Only(BusKind::SocketCan)));
    assert!(only[0].starts_with(
        "fault: the kernel (6.1.0) does not support CAN, which --bus-kind socketcan needs | sudo",
    ));
    assert_eq!(only.len(), 1, "nothing is said of interfaces: {only:?}");
    let mut facts = no_can(KindChoice::Auto);
    facts.embedded = Err("/tmp/skinbus-1 has mode 0755".into());
    assert!(complaints(&facts).contains(&"fault: /tmp/skinbus-1 has mode 0755".to_owned()));
    assert!(!would_bench_run(&assess_machine(&facts)));
}

#[test]
fn hardware_of_a_skin_that_is_a_vcan_is_noted() {
    let note = |ours| {
        about(|facts| {
            let bus = &mut facts.buses[0];
            bus.target.skin.as_mut().unwrap().rates.bitrate = Some(500_000);
            bus.interface.as_mut().unwrap().ours = ours;
        })
    };
    let text =
        "note: vcan0 is a vcan, which has no bit rate, but the skin specifies one, as for hardware | sudo";
    let why = "vcan0  # if this name belongs to hardware";
    assert_eq!(note(true), [format!("{text} vcan-setup down {why}")]);
    assert_eq!(note(false), [format!("{text} ip link del {why}")]);
}

#[test]
fn a_bus_of_either_kind_that_is_absent_is_made_by_a_run_that_starts_its_cells() {
    let absent = |no_spawn: bool, heard: Option<ObservedTraffic>| {
        about(|facts| {
            facts.buses = vec![BusFacts { traffic: Ok(heard), ..bus(None) }];
            facts.no_spawn = no_spawn;
        })
    };
    let text = "there is no interface vcan0";
    assert_eq!(
        absent(false, None),
        [format!(
            "note: {text}, so a run that starts its cells uses an embedded bus; for SocketCAN: | sudo \
             vcan-setup up skin.toml"
        )]
    );
    assert_eq!(
        absent(true, None),
        [format!(
            "fault: {text}, and no running program serves an embedded bus of this name | sudo vcan-setup up \
             skin.toml | vcan-setup serve vcan0 &"
        )]
    );
    assert_eq!(absent(true, Some(ObservedTraffic::default())).len(), 1, "no cell sends there");
}

#[test]
fn a_missing_interface_is_made_by_up_and_who_may_not_needs_sudo() {
    let missing = |user: User, vcan: ModuleState| {
        about(|facts| {
            facts.choice = KindChoice::Only(BusKind::SocketCan);
            facts.buses = vec![bus(None)];
            facts.user = user;
            facts.kernel.vcan = vcan;
        })
    };
    let anybody = User { root: false, admin: false };
    let admin = User { root: true, admin: true };
    assert_eq!(
        missing(anybody, ModuleState::Available),
        [
            "note: this user may not make interfaces, so the commands below use sudo",
            "fault: there is no interface vcan0 | sudo vcan-setup up skin.toml",
        ]
    );
    assert_eq!(
        missing(admin, ModuleState::Available),
        ["fault: there is no interface vcan0 | vcan-setup up skin.toml"]
    );
    let loadable = "note: the kernel module vcan is not loaded; making an interface loads it | modprobe vcan";
    assert_eq!(missing(admin, ModuleState::Loadable)[0], loadable);
    assert!(
        missing(admin, ModuleState::Missing)[0]
            .starts_with("fault: the kernel (6.1.0) supports CAN, but not vcan | ")
    );
    assert!(
        missing(admin, ModuleState::Unknown)[0]
            .starts_with("note: it is unknown whether the kernel supports vcan",)
    );
    let contained = missing(User { root: true, admin: false }, ModuleState::Available);
    assert!(contained[0].starts_with("fault: root may not make interfaces here: it has no CAP_NET_ADMIN"));
    let named = about(|facts| {
        facts.choice = KindChoice::Only(BusKind::SocketCan);
        facts.buses = vec![BusFacts { target: InterfaceTarget::named("vcan9"), cells: None, ..bus(None) }];
        facts.user = admin;
    });
    assert_eq!(named, ["fault: there is no interface vcan9 | vcan-setup up vcan9"]);
    let hardware = about(|facts| {
        facts.choice = KindChoice::Only(BusKind::SocketCan);
        facts.buses = vec![bus(None)];
        facts.buses[0].target.skin.as_mut().unwrap().rates.bitrate = Some(500_000);
        facts.user = admin;
    });
    assert!(hardware[0].starts_with(
        "fault: there is no interface vcan0, and the skin gives it a bitrate, so it is hardware | # plug it in"
    ));
}

#[test]
fn an_interface_that_does_not_fit_is_repaired_by_who_made_it() {
    let narrow = "fault: vcan0 has MTU 16, but CAN FD needs 72";
    assert_eq!(about_interface(|it| it.mtu = 16), [format!("{narrow} | sudo vcan-setup up skin.toml")]);
    assert_eq!(
        about_interface(|it| (it.mtu, it.ours) = (16, false)),
        [format!("{narrow} | sudo sh -c 'ip link set vcan0 down && ip link set vcan0 mtu 72 up'")]
    );
    assert_eq!(about_interface(|it| it.up = false), ["fault: vcan0 is down | sudo vcan-setup up skin.toml"]);
    assert_eq!(
        about_interface(|it| (it.up, it.ours) = (false, false)),
        ["fault: vcan0 is down | sudo sh -c 'ip link set vcan0 up'"]
    );
    assert_eq!(
        about_interface(|it| it.kind = InterfaceKind::Other("a network interface (ether)".into())),
        ["fault: vcan0 is a network interface (ether), which does not carry CAN | # use another bus"]
    );
    let classic = about(|facts| {
        facts.buses[0].target.format = Format::Classic;
        facts.buses[0].interface.as_mut().unwrap().mtu = CLASSIC_MTU;
    });
    assert_eq!(classic, Vec::<String>::new());
}

#[test]
fn hardware_has_to_have_the_skins_bit_rates_and_to_take_part() {
    let same = |_: &mut InterfaceTarget| ();
    let fine = |_: &mut Interface, _: &mut CanHardware| ();
    assert_eq!(about_hardware(same, fine), Vec::<String>::new());
    let set = "sudo vcan-setup up skin.toml --set-bit-rates";
    assert_eq!(
        about_hardware(same, |_, hardware| hardware.data_bitrate = Some(2_000_000)),
        [format!(
            "fault: can0 is CAN hardware (kvaser_pci) with 1000 kbit/s, data 2000 kbit/s, but the skin requires 1000 \
             kbit/s, data 5000 kbit/s | {set}"
        )]
    );
    assert_eq!(
        about_hardware(same, |can0, _| can0.up = false),
        [format!("fault: can0 is CAN hardware (kvaser_pci), but down | {set}")]
    );
    let open = |target: &mut InterfaceTarget| {
        let skin = target.skin.as_mut().unwrap();
        skin.rates = HardwareRates::default();
    };
    let unsaid = about_hardware(open, fine);
    assert_eq!(unsaid.len(), 1);
    assert!(
        unsaid[0]
            .starts_with("note: can0 runs at 1000 kbit/s, data 5000 kbit/s; the skin specifies no bit rate",)
    );
    let narrow = about_hardware(open, |can0, _| can0.mtu = CLASSIC_MTU);
    assert!(
        narrow[0].starts_with("fault: can0 is CAN hardware (kvaser_pci) with MTU 16, and CAN FD needs 72")
    );
    let state = |state| about_hardware(same, move |_, hardware| hardware.state = Some(state));
    let bus_off = state(ControllerState::BusOff);
    assert!(
        bus_off[0].starts_with("fault: can0 is BUS-OFF")
            && bus_off[0].contains("sudo ip link set can0 type can restart")
    );
    assert!(
        state(ControllerState::ErrorPassive)[0].starts_with("note: can0 is ERROR-PASSIVE: it detects errors")
    );
    let deaf = about_hardware(same, |_, hardware| hardware.listen_only = true);
    assert!(deaf[0].starts_with("fault: can0 is in listen-only mode"));
}

#[test]
fn another_gateway_and_cells_that_are_there_end_a_run_before_it_begins() {
    assert_eq!(
        listens(ObservedTraffic { gateway: true, ..ObservedTraffic::default() }, false),
        [
            "fault: another gateway sends joints messages on vcan0 | pgrep -a skinbus  # shows the gateway: stop it, \
             or use another bus"
        ]
    );
    let there = listens(cells(1..=14), false);
    assert!(there[0].starts_with(
        "fault: cells are already on vcan0: 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12 and 2 more | skinbus run \
         ... --no-spawn"
    ));
    assert_eq!(listens(cells(1..=100), true), Vec::<String>::new());
    assert_eq!(
        listens(cells(2..=100), true),
        ["note: 99 cells are on vcan0; these cells of the skin sent nothing: 1"]
    );
    assert!(listens(cells([]), true)[0].starts_with("fault: no cell sends on vcan0"));
    let embedded = |heard| {
        let mut facts = no_can(KindChoice::Auto);
        facts.buses[0].traffic = Ok(heard);
        complaints(&facts).split_off(1)
    };
    assert_eq!(embedded(None), Vec::<String>::new(), "the gateway will serve it");
    let other_gateway = Some(ObservedTraffic { gateway: true, ..ObservedTraffic::default() });
    assert!(
        embedded(other_gateway)[0]
            .starts_with("fault: another gateway sends joints messages on the embedded bus vcan0")
    );
}

#[test]
fn a_bus_that_does_not_open_says_why() {
    let said = about(|facts| facts.buses[0].traffic = Err("not allowed to open vcan0".into()));
    assert_eq!(said, ["fault: not allowed to open vcan0"]);
}

#[test]
fn a_receive_buffer_holds_one_answer_at_least_and_should_hold_four() {
    let granted = |bytes| about(|facts| facts.receive_buffer = Some(bytes));
    let hint = "sudo sysctl -w net.core.rmem_max=409600";
    assert_eq!(granted(400 << 10), Vec::<String>::new());
    assert_eq!(
        granted((400 << 10) - 1),
        [format!(
            "note: receive buffers are limited to 399 KiB; to hold the answers of all cells (100 frames) 4 \
             times, they need 400 KiB, otherwise a delayed gateway loses answers | {hint}"
        )]
    );
    assert!(granted(100 << 10)[0].starts_with("note"));
    assert_eq!(
        granted((100 << 10) - 1),
        [format!(
            "fault: receive buffers are limited to 99 KiB and cannot hold the answers of all cells (100 \
             frames) even once; they need 400 KiB | {hint}"
        )]
    );
    let classic = about(|facts| {
        facts.receive_buffer = Some(400 << 10);
        facts.buses[0].target.format = Format::Classic;
    });
    assert!(
        classic[0].contains("to hold the answers of all cells (200 frames) 4 times, they need 800 KiB"),
        "{classic:?}"
    );
}

#[test]
fn the_backlog_holds_an_answer_of_every_cell_of_every_bus() {
    let backlog = |frames| about(|facts| facts.backlog = frames);
    assert_eq!(backlog(Some(100)), Vec::<String>::new());
    assert_eq!(
        backlog(Some(99)),
        ["fault: the kernel's receive backlog of 99 cannot hold the answers of all cells (100 frames): \
             some would be lost silently | sudo sysctl -w net.core.netdev_max_backlog=200"]
    );
    assert!(backlog(None)[0].starts_with("note: the kernel's receive backlog cannot be read"));
    let two = about(|facts| {
        facts.backlog = Some(150);
        facts.buses.push(bus(Some(interface("vcan1", InterfaceKind::Vcan))));
    });
    assert!(two[0].starts_with("fault: the kernel's receive backlog of 150"), "{two:?}");
}

#[test]
fn without_a_skin_some_interface_has_to_be_of_use() {
    let machine = |present: Vec<Interface>| {
        about(|facts| (facts.buses, facts.present, facts.user.admin) = (Vec::new(), present, true))
    };
    assert_eq!(machine(vec![interface("vcan3", InterfaceKind::Vcan)]), Vec::<String>::new());
    let down = Interface { up: false, ..interface("vcan3", InterfaceKind::Vcan) };
    let expected = "fault: no CAN interface is up | vcan-setup up vcan0";
    for present in [vec![], vec![down]] {
        assert_eq!(machine(present)[0], expected);
    }
}

#[test]
fn the_cells_program_is_needed_unless_the_cells_are_there() {
    let without = |no_spawn| {
        about(|facts| {
            (facts.cell_node.there, facts.no_spawn) = (false, no_spawn);
            facts.buses[0].traffic = Ok(Some(cells(1..=100)));
        })
    };
    assert!(without(false)[1].starts_with("fault: cell-node is not at /bin/cell-node"));
    assert_eq!(without(true), Vec::<String>::new());
}

#[test]
fn sums_run_wherever_nothing_real_is() {
    let sums = |facts: &mut MachineFacts| facts.buses.iter_mut().for_each(|bus| bus.sums = true);
    assert_eq!(about(sums), Vec::<String>::new());
    let said = about(|facts| {
        let hardware = CanHardware { bitrate: Some(1_000_000), ..CanHardware::default() };
        facts.buses = vec![bus(Some(interface("can0", InterfaceKind::Hardware(hardware))))];
        sums(facts);
    });
    let expected = "fault: can0 is CAN hardware, but cells that answer with sums simulate their wires with \
                    frames that must not be sent there | reply = \"torque\"  # in the skin; or name a vcan or the \
                    embedded bus";
    assert_eq!(said.iter().filter(|line| line.starts_with("fault")).collect::<Vec<_>>(), [expected]);
}
