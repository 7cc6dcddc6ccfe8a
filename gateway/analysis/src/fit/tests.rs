//! Tests results for skins against known values, and every hint against the resulting skin.

mod simulated;
mod starving;

use protocol::can::Format;
use protocol::skin::Skin;
use protocol::wire_time::BitRates;

use super::case::{AnswerPlan, BusCase};
use super::limits::{Limit, MaxCells};
use super::verdict::FitVerdict;
use super::{
    BusFit, PAPER_COMPUTATION_NS, assess_bus, fit_json, most_loaded_bus, rates_table, spread_over_buses,
};
use model::generate::{ReplyMode, SkinRequest, generate};

fn text(target: &SkinRequest) -> String {
    generate(target).unwrap()
}

fn skin(text: &str) -> Skin {
    Skin::parse("skin.toml", text).unwrap()
}

fn fit(skin: &Skin, rates: &str) -> BusFit {
    let (format, rates) = match rates.strip_prefix("classic ") {
        Some(rates) => (Format::Classic, rates),
        None => (Format::Fd, rates),
    };
    assess_bus(skin, 0, format, rates.parse().unwrap(), PAPER_COMPUTATION_NS).unwrap()
}

#[test]
fn packets_take_what_is_known_of_them() {
    let skin = skin(&text(&SkinRequest { cells: 1, ..SkinRequest::default() }));
    for (rates, us) in [
        ("500k/2M", 160.0),
        ("500k/5M", 102.4),
        ("1M/2M", 128.0),
        ("1M/5M", 70.4),
        ("1M/8M", 56.0),
        // Two frames of 133 bits; without counting the CRC's stuff bits, a classic frame of 8 bytes has 134.
        ("classic 1M", 266.0),
        ("classic 500k", 532.0),
    ] {
        let packet_us = fit(&skin, rates).rated.case.longest_packet_ns() as f64 / 1e3;
        assert!((packet_us - us).abs() < 1e-9, "{rates}: {packet_us}");
    }
}

#[test]
fn the_whole_arm_is_too_much_for_one_bus_at_1m_5m_and_three_are_needed_electrically() {
    let fit = fit(&skin(&text(&SkinRequest::default())), "1M/5M");
    let load = fit.rated.load;
    let share = |packets: f64| packets * 70.4 / 16_000.0;
    assert!((load.joints + load.answers - share(254.0)).abs() < 1e-12, "111.76 %: {load:?}");
    assert!((load.heartbeats - share(253.0 * 0.064)).abs() < 1e-12);
    assert_eq!(load.sensors.to_bits(), 0);
    assert_eq!(fit.rated.exceeded, [Limit::Bandwidth, Limit::Deadline, Limit::Nodes]);
    assert_eq!(fit.rated.times.last_answer_ns(), None);
    assert_eq!(fit.rated.times.heartbeat_ns, None);
    // 212 * 70.4 * 1.064 + 70.4 = 15 950 of 16 000 us; 223 * 70.4 + 3 * 70.4 + 68.5 = 15 979 us.
    assert_eq!(fit.most, MaxCells { bandwidth: 212, deadline: 223, nodes: 109 });
    assert_eq!((fit.need.buses_for_timing(), fit.need.required_buses()), (Some(2), Some(3)));
    assert_eq!(fit.need.binding_limits(), [Limit::Nodes]);
}

#[test]
fn at_1m_8m_it_is_in_time_and_the_chain_is_the_smaller_bound() {
    let fit = fit(&skin(&text(&SkinRequest::default())), "1M/8M");
    assert_eq!(fit.rated.exceeded, [Limit::Nodes]);
    assert_eq!(fit.rated.verdict(), FitVerdict::Nodes(254));
    // Blocking, joints, computation, blocking, 253 torques.
    assert_eq!(fit.rated.times.chain_ns, Some(56_000 * (3 + 253) + 68_500));
    let response = fit.rated.times.response_ns.unwrap();
    // Response-time analysis counts joints and blocking once more for the torque itself.
    assert_eq!(response.worst_ns, 56_000 * (4 + 253) + 68_500);
    assert_eq!(fit.rated.times.last_answer_ns(), fit.rated.times.chain_ns);
    assert!(fit.hints.iter().all(|it| it.change == "3 buses of 85 cells"));
}

#[test]
fn a_single_cell_waits_for_joints_and_one_heartbeat_at_most() {
    let case = fit(&skin(&text(&SkinRequest { cells: 1, ..SkinRequest::default() })), "1M/5M").rated.case;
    // Its own heartbeat: once before the joints, once while it computes.
    assert_eq!(case.times().chain_ns, Some(4 * 70_400 + 68_500));
    // A cell that needs no time to compute answers before other frames start.
    let at_once = BusCase { computation_ns: 0, ..case };
    assert_eq!(at_once.times().chain_ns, Some(3 * 70_400));
}

#[test]
fn the_most_cells_fit_and_one_more_does_not_at_all_rates_and_with_sensors() {
    let text = text(&SkinRequest { cells: 40, ..SkinRequest::default() });
    let format = "format = \"fd\"";
    for sensing in ["", "\nsensing = \"event\"", "\nsensing = \"continuous\"\nsensing_hz = 62.5"] {
        let skin = skin(&text.replace(format, &format!("{format}{sensing}")));
        for row in rates_table(&skin, None, PAPER_COMPUTATION_NS) {
            let (case, most) = (&row.fullest.rated.case, row.fullest.most);
            for (limit, cells) in [(Limit::Bandwidth, most.bandwidth), (Limit::Deadline, most.deadline)] {
                let exceeded = |cells| super::exceeded_limits(&case.with_cells(cells)).contains(&limit);
                assert!(cells > 0 && !exceeded(cells) && exceeded(cells + 1), "{limit:?} {cells} {case:?}");
            }
        }
    }
}

#[test]
fn sensors_are_loaded_with_what_they_say() {
    let text = text(&SkinRequest { cells: 40, ..SkinRequest::default() });
    let format = "format = \"fd\"";
    let sensors = |sensing: &str| {
        let skin = skin(&text.replace(format, &format!("{format}\n{sensing}")));
        fit(&skin, "1M/5M").rated.load.sensors
    };
    // Page 0, and page 1 once a second, of 40 cells.
    let share = |hz: f64| 40.0 * hz * 70.4e-6;
    assert!((sensors("sensing = \"continuous\"\nsensing_hz = 62.5") - share(63.5)).abs() < 1e-9);
    assert!((sensors("sensing = \"event\"") - share(5.0)).abs() < 1e-9);
}

#[test]
fn every_hint_does_in_a_description_what_it_says() {
    let target = SkinRequest { cells: 200, ..SkinRequest::default() };
    let format = "format = \"fd\"";
    let sensing = "sensing = \"continuous\"\nsensing_hz = 20.0";
    let text = text(&target).replace(format, &format!("{format}\n{sensing}"));
    let before = fit(&skin(&text), "500k/5M");
    let changes: Vec<_> = before.hints.iter().map(|it| it.change.as_str()).collect();
    assert_eq!(
        changes,
        ["2 buses of 100 cells", "1M/8M", "joint_broadcast_hz = 22.727273", "sensing = \"event\", quiet",]
    );
    for hint in &before.hints {
        let rates = hint.change.parse::<BitRates>().unwrap_or_else(|_| "500k/5M".parse().unwrap());
        let other = if hint.change.starts_with("joint") {
            text.replace("joint_broadcast_hz = 62.5", &hint.change)
        } else if hint.change.starts_with("sensing") {
            text.replace(sensing, "sensing = \"event\"")
        } else if hint.change.contains("buses") {
            let two = generate(&SkinRequest { buses: 2, ..target.clone() }).unwrap();
            two.replace(format, &format!("{format}\n{sensing}"))
        } else {
            text.clone()
        };
        let skin = skin(&other);
        let buses = (0..skin.buses.len())
            .filter_map(|index| assess_bus(&skin, index, Format::Fd, rates, PAPER_COMPUTATION_NS));
        let buses: Vec<_> = buses.collect();
        let after = most_loaded_bus(buses.iter()).unwrap().rated.clone();
        assert_eq!(after, hint.after, "{}", hint.change);
    }
}

#[test]
fn sums_of_all_cells_save_no_frame_and_those_of_roots_all_others() {
    let skin = skin(&text(&SkinRequest { buses: 3, ..SkinRequest::default() }));
    let fit = fit(&skin, "1M/5M");
    let [shared, roots] = &fit.answers[..] else { panic!("{:?}", fit.answers) };
    assert_eq!(shared.after.load, fit.rated.load);
    assert!(
        shared.after.times.last_answer_ns() > fit.rated.times.last_answer_ns(),
        "parents wait for their children"
    );
    assert_eq!(roots.after.case.answers.cells(), 1);
    let packets = roots.after.load.total() / (70.4 / 16_000.0);
    assert!((packets - 2.064).abs() < 1e-9, "joints, one sum, and that cell's heartbeats: {packets}");
    assert_eq!(roots.after.exceeded, []);
}

#[test]
fn a_skin_of_sums_is_taken_as_it_is_and_compared_with_torques() {
    let skin = skin(&text(&SkinRequest { cells: 60, reply: ReplyMode::Sum, ..SkinRequest::default() }));
    let fit = fit(&skin, "1M/5M");
    let AnswerPlan::Sums { by_depth, slot_ns, shared } = &fit.rated.case.answers else { panic!("{fit:?}") };
    let depths = skin.wires(0).cell_depths();
    let deepest = depths.iter().flatten().max().copied().unwrap();
    assert_eq!((by_depth.iter().sum::<u32>(), by_depth.len()), (60, usize::from(deepest) + 1));
    assert!(*shared && by_depth[0] == 1);
    assert!(
        matches!(skin.buses[0].reply, protocol::skin::SkinReply::Sum { slot_us, .. } if u64::from(slot_us) * 1_000 == *slot_ns)
    );
    // One computation, and one frame of another node, for every wire on the route to the root.
    let chain_ns = 70_400 * 62 + (u64::from(deepest) + 1) * (68_500 + 70_400);
    assert_eq!(fit.rated.times.chain_ns, Some(chain_ns));
    let changes: Vec<_> = fit.answers.iter().map(|it| it.change.as_str()).collect();
    assert_eq!(changes, ["torques", "sums, only of roots"]);
    // Half of the cells, half of every depth.
    let segment = fit.rated.case.answers.with_cells(30);
    assert_eq!(segment.cells(), 30);
}

#[test]
fn json_has_the_same_figures_and_null_where_there_is_no_bound() {
    let skin = skin(&text(&SkinRequest::default()));
    let fits = [fit(&skin, "1M/5M")];
    let json = fit_json(&skin, &fits, spread_over_buses(&skin, &fits).as_ref(), &[]);
    let bus = &json["buses"][0];
    assert_eq!((bus["bus"].as_str(), bus["name"].as_str()), (Some("vcan0"), Some("1M/5M")));
    assert_eq!((bus["nominal"].as_u64(), bus["data"].as_u64()), (Some(1_000_000), Some(5_000_000)));
    assert!((bus["load"]["total"].as_f64().unwrap() - 1.1889).abs() < 1e-4);
    assert!(bus["last_answer_us"].is_null() && bus["heartbeat_us"].is_null());
    assert_eq!(bus["exceeded"], serde_json::json!(["bandwidth", "deadline", "nodes"]));
    assert_eq!(bus["most_cells"], serde_json::json!({ "bandwidth": 212, "deadline": 223, "nodes": 109 }));
    assert_eq!(bus["buses_needed"]["buses"].as_u64(), Some(3));
    assert_eq!(bus["buses_needed"]["binding"], serde_json::json!(["nodes"]));
    let three = &json["whole"]["spread"][2];
    assert_eq!((three["buses"].as_u64(), three["fullest"]["cells"].as_u64()), (Some(3), Some(85)));
    let last_us = three["fullest"]["last_answer_us"].as_f64().unwrap();
    assert!((last_us - (88.0 * 70.4 + 68.5)).abs() < 1e-9);
    assert!(json["table"].is_null());
}
