//! Benches beside third-party tools: `tests/tools/run`.

mod tools_captures;
mod tools_chains;
mod tools_dbc;
mod tools_foxglove;
mod tools_man;
mod tools_power_loss;
mod tools_recording;
mod tools_report;
mod tools_slcan;
mod tools_view;
