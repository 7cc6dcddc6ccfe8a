//! Complete benches in virtual time: a queue of events, a clock that the test moves, faults from a seed.

mod bench_baseline;
mod bench_bus;
mod bench_cells;
mod bench_chaos;
mod bench_commission;
mod bench_conformance;
mod bench_explain;
mod bench_frames;
mod bench_hostile;
mod bench_loop;
mod bench_network;
mod bench_parts;
mod bench_replay;
mod bench_sensing;
mod bench_sound;
mod bench_sums;
mod bench_touches;
mod bus_time;
