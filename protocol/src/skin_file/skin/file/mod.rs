//! Writers of skin files: an [`Edit`] changes values in an existing text and keeps all other bytes; a [`Draft`] creates
//! a new text.

mod draft;
mod edit;
#[cfg(test)]
mod tests;
mod value;

pub use draft::{Draft, DraftBus, DraftCell, Facing};
pub use edit::{Edit, EditError};
pub use value::Value;
