//! Tests of the loop under a counting allocator.

mod tick;
