//! Tests that need a whole kernel, in a virtual machine for each module: `tests/vcan`.

mod lab_backlog;
mod lab_clock;
mod lab_icount;
mod lab_icount_record;
mod lab_kvaser;
mod lab_kvaser_rates;
mod lab_readme;
