//! The one writer of skin files: an [`Edit`] changes values of a given text and keeps every other byte, a [`Draft`] makes a new
//! text.

mod draft;
mod edit;
#[cfg(test)]
mod tests;
mod value;

pub use draft::{Draft, DraftBus, DraftCell, Facing};
pub use edit::{Edit, EditError};
pub use value::Value;
