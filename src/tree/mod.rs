//! The built-in scene `tree`, made in code from a seed.

use crate::error::{Result, during};
use crate::scene::Parts;

/// What the tree is made from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Recipe {
    pub seed: u64,
}

impl Default for Recipe {
    fn default() -> Self {
        Self { seed: 7 }
    }
}

/// Grows the tree.
///
/// # Errors
/// `Fault` when the eigenproblem of a beam does not converge.
pub fn grow(recipe: &Recipe) -> Result<Parts> {
    Err(during("tree")(format!("not grown yet: {recipe:?}")))
}
