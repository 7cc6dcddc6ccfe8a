//! Writers of skin files: an [`SkinEdit`] changes values in an existing text and keeps all other bytes; a [`SkinDraft`]
//! creates a new text.

mod draft;
mod edit;
#[cfg(test)]
mod tests;
mod value;

pub use draft::{CellFacing, DraftBus, DraftCell, SkinDraft};
pub use edit::{EditError, SkinEdit};
pub use value::Value;
