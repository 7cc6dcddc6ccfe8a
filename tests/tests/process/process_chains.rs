//! Robots with several chains and with prismatic joints: run, recorded, shown, replayed and reported.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::float_cmp,
    reason = "a test may stop, and multiples of a step are exact"
)]

use skinbus_tests::process;
use skinbus_tests::process::recorded;

use std::collections::BTreeMap;
use std::fs;

use process::{Ended, TestDir, example};
use recorded::Recorded;
use serde_json::Value;

const PRESS: &str = r#"version = 1
duration_s = 60.0

[[mode]]
at_s = 0.0
kind = "compare"

[[touch]]
at_s = 0.1
for_s = 60.0
all = true
force_n = 2.0
profile = "step"
"#;

const HEAD: &str = "link,px,py,pz,nx,ny,nz";

fn run(place: &TestDir, words: &str) -> Ended {
    place.start("skinbus", words).end().succeeded()
}

/// Writes `skin.toml` of an example robot with these cells, and a scenario that presses all of them.
fn robot(file: &str, tips: &str, cells: &str) -> TestDir {
    let place = TestDir::new();
    fs::copy(example(file), place.path(file)).unwrap();
    place.write("cells.csv", &format!("{HEAD}\n{cells}"));
    run(&place, &format!("skin import {file} {tips} --places cells.csv -o skin.toml"));
    place.scenario(PRESS);
    place
}

fn objects(place: &TestDir, words: &str) -> Vec<Value> {
    run(place, words).stdout.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

fn explained(place: &TestDir, epoch: u64, at: u64) -> Value {
    let words = format!("explain run.mcap --epoch {epoch} --at {at} --json");
    serde_json::from_str(&run(place, &words).stdout).unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

/// Left arm: joints 1 to 7 of the robot; right arm: 1, 2 and 8 to 12.
const CHAINS: [(&str, [usize; 7]); 2] =
    [("vcan0", [0, 1, 2, 3, 4, 5, 6]), ("vcan1", [0, 1, 7, 8, 9, 10, 11])];

#[test]
fn the_torque_of_a_torso_is_that_of_both_arms() {
    let cells = "torso,0.1,0,0.2,1,0,0\nleft_upper_arm,0.05,0,-0.1,1,0,0\nleft_forearm,0,0.05,-0.1,0,1,0\n\
                 right_upper_arm,0,-0.05,-0.1,0,-1,0\nright_forearm,0.05,0,-0.1,1,0,0\n";
    let place = robot("two-arms.urdf", "--tip left_palm --tip right_palm", cells);
    place.bench(3.0, "--record run.mcap").end().succeeded();

    // The cells' torques, by bus and epoch; the arms have moved.
    let mut sent = BTreeMap::<(String, u64), Vec<Vec<f64>>>::new();
    for torque in objects(&place, "dump run.mcap --json --kind torque --from 2") {
        let key = (torque["bus"].as_str().unwrap().to_owned(), torque["epoch"].as_u64().unwrap());
        sent.entry(key).or_default().push(numbers(&torque["values"]["torque_nm"]));
    }
    // An epoch that all of them answered: on a busy machine cells skip some.
    let all_sent = |epoch: &u64| {
        CHAINS.iter().zip([3, 2]).all(|((bus, _), cells)| {
            sent.get(&((*bus).to_owned(), *epoch)).is_some_and(|words| words.len() == cells)
        })
    };
    let epoch = sent.keys().map(|(_, epoch)| *epoch).find(all_sent).unwrap();
    let mut sums = [0.0; 12];
    for (bus, joints) in CHAINS {
        let words = &sent[&(bus.to_owned(), epoch)];
        for (place, joint) in joints.into_iter().enumerate() {
            sums[joint] += words.iter().map(|words| words[place]).sum::<f64>();
        }
    }
    let explained = explained(&place, epoch, 2);
    let total: Vec<_> = explained["total"].as_array().unwrap().iter().collect();
    assert_eq!(total.len(), 12);
    for (total, sum) in total.iter().zip(sums) {
        assert_eq!(total["words_nm"].as_f64().unwrap(), sum, "{total}");
        assert!((total["central_nm"].as_f64().unwrap() - sum).abs() < 5e-3, "{total}");
    }
    assert!(sums[1].abs() > 0.1, "the torso bears a load: {sums:?}");
    // The robot's joint numbers, also for a chain that counts differently.
    let last = explained["cells"].as_array().unwrap().last().unwrap();
    let numbered =
        |value: &Value| value.as_array().unwrap().iter().map(|it| it.as_u64().unwrap()).collect::<Vec<_>>();
    assert_eq!((last["bus"].as_str().unwrap(), last["joint"].as_u64().unwrap()), ("vcan1", 11));
    assert_eq!(numbered(&explained["buses"][1]["joints"]), [1, 2, 8, 9, 10, 11, 12]);
    let text = run(&place, &format!("explain run.mcap --epoch {epoch} --at 2")).stdout;
    let widest = text.lines().filter(|line| line.starts_with('│')).map(|line| line.chars().count()).max();
    assert!(widest.unwrap() <= 80, "{text}");

    // The loop's torque and position of each joint, once.
    let recorded = Recorded::read(&place.path("run.mcap"));
    let state = recorded.on("/two_arms/joint_states").last().unwrap();
    let names: Vec<_> =
        state.value["name"].as_array().unwrap().iter().map(|it| it.as_str().unwrap()).collect();
    assert_eq!((names.len(), names[0], names[7]), (12, "waist_yaw", "right_shoulder_pitch"));
    assert_eq!(numbers(&state.value["position"]).len(), 12);
    let torques = recorded.on("/two_arms/torques").last().unwrap();
    assert_eq!(numbers(&torques.value["distributed"]).len(), 12, "{}", torques.value);

    // Two arms need two buses, even if one bus has room for all cells.
    let fit: Value =
        serde_json::from_str(&run(&place, "fit skin.toml --nominal 1M --data 5M --json").stdout).unwrap();
    assert!(fit["whole"]["buses_needed"]["buses"].as_u64().unwrap() >= 2, "{}", fit["whole"]);

    let (ended, replayed) = place.replayed("run.mcap", "--expect --spawn --lockstep --speed 4");
    assert!(replayed.all_came_back(&ended) > 90, "{:#}", replayed.0);
    run(&place, "report run.mcap -o run.html");
    let page = place.read("run.html");
    for name in ["waist_pitch", "left_elbow", "right_elbow"] {
        assert!(page.contains(name), "{name}");
    }
}

#[test]
fn a_joint_that_slides_has_its_own_units() {
    let place = robot("lift.urdf", "--tip tool", "tool,0,0.05,0,0.6,0,0.8\n");
    place.bench(2.0, "--record run.mcap").end().succeeded();
    let (log, mcap) = ("run.log --skin skin.toml", "run.mcap");
    let shown: Vec<Vec<Value>> = [log, mcap]
        .iter()
        .map(|source| objects(&place, &format!("dump {source} --json --kind joints,torque")))
        .collect();
    let values = |of: &[Value]| of.iter().map(|object| object["values"].clone()).collect::<Vec<_>>();
    assert!(shown[0].len() > 20, "{}", shown[0].len());
    assert_eq!(values(&shown[0]), values(&shown[1]), "the skin in the recording is that of --skin");
    let torque = shown[0].iter().rev().find(|object| object["kind"] == "torque").unwrap();
    let (epoch, sent) = (torque["epoch"].as_u64().unwrap(), numbers(&torque["values"]["torque_nm"]));
    let heard = |object: &&Value| object["kind"] == "joints" && object["epoch"] == epoch;
    let joints = shown[0].iter().rev().find(heard).unwrap();
    let positions = numbers(&joints["values"]["position_rad"]);
    // The component of 2 N along the lift, in words of 2^-10 N.
    assert!(sent[0] != 0.0 && sent[0].abs() <= 2.0 && (sent[0] * 1024.0).fract() == 0.0, "{sent:?}");
    let all = explained(&place, epoch, 1);
    let [rows, bus] = [&all["cells"][0]["rows"], &all["buses"][0]];
    assert_eq!((&bus["units"][0], numbers(&bus["position_rad"])), (&Value::from("m"), positions));
    let explained: Vec<_> =
        rows.as_array().unwrap().iter().map(|row| row["word_nm"].as_f64().unwrap()).collect();
    assert_eq!((&rows[0]["unit"], explained), (&Value::from("N"), sent.clone()));
    let text = run(&place, "dump run.mcap --brief --kind joints,torque --from 1").stdout;
    let expected = format!("torque 1 epoch {epoch}: {:.4} N {:.4}", sent[0], sent[1]);
    assert!(text.contains(&expected) && text.contains(" m "), "{expected}\n{text}");

    // Without the skin the words are decoded as Q3.12 and rad.
    let plain = objects(&place, "dump run.log --json --kind torque --from 1");
    let plain = plain.iter().rev().find(|object| object["epoch"] == epoch).unwrap();
    assert_eq!(numbers(&plain["values"]["torque_nm"])[0] * 4.0, sent[0]);
    let ended = place.start("skinbus", "dump run.log --skin nowhere.toml").end();
    assert!(ended.refusal(2).contains("nowhere.toml"));

    // The skin of another robot is reported, and not used.
    fs::copy(example("panda.urdf"), place.path("panda.urdf")).unwrap();
    run(&place, "skin import panda.urdf --tip hand -o other.toml");
    let another = "joints messages on vcan0 have 8 positions, but the skin's chain on this bus has 7 joints: name \
                   the skin of this robot";
    let ended = run(&place, "dump run.log --skin other.toml --json --kind torque --from 1");
    assert!(ended.stderr.contains(another) && ended.stderr.lines().count() == 1, "{}", ended.stderr);
    let raw: Value = serde_json::from_str(ended.stdout.lines().last().unwrap()).unwrap();
    let same: Value = objects(&place, "dump run.log --json --kind torque --from 1").pop().unwrap();
    assert_eq!(raw["values"], same["values"]);
    let ended = place.start("skinbus", "explain run.mcap --skin other.toml --epoch 3").end();
    assert!(ended.refusal(1).contains(another), "{}", ended.stderr);
}

#[test]
fn a_report_names_the_torque_format_that_would_have_fitted() {
    let place = robot("panda.urdf", "--tip hand", "hand,0.1,0,0.03,1,0,0\n");
    place.scenario(&format!(
        "{PRESS}\n[motion]\nkind = \"hold\"\nstart = [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8]\n"
    ));
    let report = || {
        place.bench(1.5, "--record run.mcap").end().succeeded();
        run(&place, "report run.mcap -o run.html --overwrite");
        place.read("run.html").split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let page = report();
    assert!(!page.contains("would have been better") && page.contains("vcan0 Q3.12, used"), "it fits");
    place.scenario(&place.read("scenario.toml").replace("force_n = 2.0", "force_n = 60.0"));
    let page = report();
    let advice = "vcan0: the torque format Q5.10 would have been better: ";
    let (_, advice) = page.split_once(advice).expect("advice");
    let advice = advice.split_once("</p>").expect("a sentence").0.replace('\u{a0}', " ");
    let between = " torques are beyond 8 Nm, the range of Q3.12. Its mean rounding error is ";
    let (torques, rounds) = advice.split_once(between).unwrap();
    assert!(torques.parse::<u32>().unwrap() > 0, "{advice}");
    let (better, worse) = rounds.split_once(" µNm instead of ").unwrap();
    let worse = worse.split_once(" µNm.").unwrap().0;
    let [better, worse] = [better, worse].map(|text| text.parse::<f64>().unwrap());
    assert!(worse > 10.0 && better > worse && better < 1_000.0, "a coarser step: {advice}");
    let skin =
        place.read("skin.toml").replace("name = \"vcan0\"\n", "name = \"vcan0\"\ntorque_format = \"Q7.8\"\n");
    place.write("skin.toml", &skin);
    let page = report();
    let advice = "vcan0: the torque format Q5.10 would have been better: it also covers every torque";
    assert!(page.contains(advice), "a finer one");
}
