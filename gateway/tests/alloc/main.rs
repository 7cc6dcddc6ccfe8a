//! A loop under an allocator that counts.

mod tick;
