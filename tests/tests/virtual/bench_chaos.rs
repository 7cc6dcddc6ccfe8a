//! Complete benches with many faults, for hundreds of seeds: nothing panics, every account adds up, and every torque
//! that a tick uses is the one that the oracle expects.

#![allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::print_stdout,
    reason = "a test may stop, and say where"
)]

use model::table::{FrameEvent, UplinkCounts};
use protocol::can::Format;
use protocol::id::Kind;
use protocol::message::Message;
use protocol::skin::Skin;
use protocol::time::{Micros, Span};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skinbus_tests::accounts;
use skinbus_tests::bench::{Act, Bench};
use skinbus_tests::fault::{Fault, Harm, Party};
use skinbus_tests::skins;

/// The number of seeds of each kind of fault.
const SEEDS: u64 = 100;
const CELLS: u8 = 5;

/// Prints a run; the last of these lines names the run that failed.
fn print_run(harm: Option<Harm>, format: Format, seed: u64) {
    println!("{harm:?} {format:?} seed {seed}");
}

/// Runs a bench of five cells that are pressed and released for two seconds, with the faults of `inject`.
fn campaign(skin: &Skin, seed: u64, inject: impl Fn(&mut Bench, &mut Pcg64Mcg)) -> Bench {
    let mut dice = Pcg64Mcg::seed_from_u64(seed);
    let mut bench = Bench::new(skin, seed).started();
    inject(&mut bench, &mut dice);
    for _ in 0..25 {
        let place = dice.random_range(0..usize::from(CELLS));
        bench.press(place, if dice.random_bool(0.3) { 0.0 } else { dice.random_range(0.2..3.0) });
        let span = Span(dice.random_range(1_000..100_000));
        bench.run(span);
    }
    bench.finish();
    accounts::check(&bench);
    bench
}

fn uplink(bench: &Bench) -> UplinkCounts {
    bench.gateway.table.uplink()
}

fn some_fault(dice: &mut Pcg64Mcg) -> Fault {
    let harm = Harm::ALL[dice.random_range(0..Harm::ALL.len())];
    let fault = Fault::new(harm, dice.random_range(0.0..0.2));
    let fault = match dice.random_range(0..4) {
        0 => fault,
        1 => fault.on_the_wire(),
        2 => fault.at_receiver(Party::Gateway),
        _ => fault.at_receiver(Party::CellSlot(dice.random_range(0..usize::from(CELLS)))),
    };
    match dice.random_range(0..3) {
        0 => fault.of_kind(Kind::ALL[dice.random_range(0..Kind::ALL.len())]),
        1 => fault.from(Party::CellSlot(dice.random_range(0..usize::from(CELLS)))),
        _ => fault,
    }
}

/// Kills, starts and hangs cells at random times.
fn some_trouble(bench: &mut Bench, dice: &mut Pcg64Mcg) {
    for _ in 0..dice.random_range(0..6) {
        let cell_slot = dice.random_range(0..usize::from(CELLS));
        let at = bench.now() + Span(dice.random_range(0..1_200_000));
        let later = at + Span(dice.random_range(0..900_000));
        let (first, then) = if dice.random() {
            (Act::Kill(cell_slot), Act::Start(cell_slot))
        } else {
            (Act::Hang(cell_slot), Act::Continue(cell_slot))
        };
        bench.at(at, first);
        bench.at(later, then);
    }
}

#[test]
fn every_harm_to_every_receiver_by_itself() {
    for format in [Format::Fd, Format::Classic] {
        let skin = skins::arm(CELLS, format);
        for harm in Harm::ALL {
            for seed in 0..SEEDS / 2 {
                print_run(Some(harm), format, seed);
                campaign(&skin, seed, |bench, _| bench.fault(Fault::new(harm, 0.1)));
            }
        }
    }
}

#[test]
fn every_harm_on_the_wire() {
    for format in [Format::Fd, Format::Classic] {
        let skin = skins::arm(CELLS, format);
        for harm in Harm::ALL {
            for seed in 0..SEEDS / 2 {
                print_run(Some(harm), format, seed);
                campaign(&skin, seed, |bench, _| bench.fault(Fault::new(harm, 0.1).on_the_wire()));
            }
        }
    }
}

#[test]
fn cells_that_are_killed_started_and_hung_at_any_time() {
    let skin = skins::arm(CELLS, Format::Fd);
    for seed in 0..2 * SEEDS {
        campaign(&skin, seed, some_trouble);
    }
}

#[test]
fn everything_at_once() {
    for format in [Format::Fd, Format::Classic] {
        let skin = skins::arm(CELLS, format);
        for seed in 0..2 * SEEDS {
            print_run(None, format, seed);
            campaign(&skin, seed, |bench, dice| {
                (0..4).for_each(|_| bench.fault(some_fault(dice)));
                some_trouble(bench, dice);
                for _ in 0..dice.random_range(0..3) {
                    let message = if dice.random() { Message::Halt } else { Message::Resume };
                    let at = bench.now() + Span(dice.random_range(0..1_500_000));
                    bench.at(at, Act::Inject(message));
                }
                bench.gateway.skip_ticks(dice.random_range(0..40));
            });
        }
    }
}

#[test]
fn loss_alone_is_found_to_the_last_packet() {
    let skin = skins::arm(CELLS, Format::Fd);
    for seed in 0..SEEDS {
        let fault = Fault::new(Harm::Lose, 0.2).at_receiver(Party::Gateway).of_kind(Kind::Torque);
        let bench = campaign(&skin, seed, |bench, _| bench.fault(fault.clone()));
        let torques = |bench: &Bench| {
            let on_the_wire =
                bench.wire.iter().filter(|it| it.frame.id() >> 8 == Kind::Torque as u32).count();
            on_the_wire as u64
        };
        let arrived = bench.gateway.table.counters().received_count(Kind::Torque);
        let uplink = uplink(&bench);
        assert_eq!(uplink.lost, torques(&bench) - arrived, "{uplink:?}");
        assert!(uplink.lost > 0 && uplink.surplus == 0 && uplink.rejected == 0, "{uplink:?}");
    }
}

#[test]
fn no_torque_with_turned_bits_is_ever_used() {
    let skin = skins::arm(CELLS, Format::Fd);
    let mut flipped = 0;
    for seed in 0..SEEDS {
        // Only torques are damaged, and most of them: those that are used must still be right.
        let fault = Fault::new(Harm::Flip, 0.7).of_kind(Kind::Torque);
        let bench = campaign(&skin, seed, |bench, _| bench.fault(fault.clone()));
        let table = &bench.gateway.table;
        assert!(table.accuracy().single.max() < 1e-3, "{:?}", table.accuracy());
        // Flipped bits of an identifier may produce another kind, which is in no cell's account.
        assert!(uplink(&bench).rejected <= table.counters().event_count(FrameEvent::Crc));
        flipped += table.counters().event_count(FrameEvent::Crc);
    }
    assert!(flipped > SEEDS * 100, "{flipped}");
}

#[test]
fn the_same_seed_is_the_same_run_byte_for_byte() {
    let skin = skins::arm(CELLS, Format::Fd);
    let run = |seed| {
        let bench = campaign(&skin, seed, |bench, dice| {
            (0..4).for_each(|_| bench.fault(some_fault(dice)));
            some_trouble(bench, dice);
        });
        bench.transcript()
    };
    for seed in 0..8 {
        let (first, second) = (run(seed), run(seed));
        assert!(first == second, "seed {seed} gave two runs");
        assert!(first != run(seed + 100), "another seed is another run");
    }
}

#[test]
fn nonsense_on_the_bus_does_no_harm() {
    use protocol::can::{ERROR, EXTENDED, Frame};
    let skin = skins::arm(CELLS, Format::Fd);
    for seed in 0..SEEDS {
        let bench = campaign(&skin, seed, |bench, dice| {
            for _ in 0..2_000 {
                let id = dice.random_range(0..0x800_u32);
                let mut data = [0_u8; 64];
                dice.fill(&mut data);
                let length = dice.random_range(0..=64);
                let frame = match dice.random_range(0..6) {
                    0 => Frame::remote(id, 8),
                    1 => Frame::classic(id | EXTENDED, &data[..8]),
                    2 => Frame::classic(id | ERROR, &data[..8]),
                    3 => Frame::classic(id, &data[..8]),
                    4 => Frame::fd(id, 1, &data[..16]),
                    _ => Frame::fd(id, 1, &data[..length]),
                };
                let at = bench.now() + Span(dice.random_range(0..1_500_000));
                bench.at(at, Act::InjectFrame(frame.unwrap()));
            }
        });
        assert!(bench.gateway.table.accuracy().single.max() < 1e-3, "{:?}", bench.gateway.table.accuracy());
        assert!(bench.now() > Micros(0));
    }
}
