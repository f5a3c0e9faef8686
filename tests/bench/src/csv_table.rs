//! Writes CSV tables whose cells are values of serialized rows.

use serde_json::Value;

use modalcast_model::error::{Result, fault_in};

/// The text of the value at a JSON pointer; empty if there is none.
pub(crate) fn cell_text(row: &Value, pointer: &str) -> String {
    match row.pointer(pointer) {
        None | Some(Value::Null) => String::new(),
        Some(Value::String(text)) => text.clone(),
        Some(other) => other.to_string(),
    }
}

/// A table with a header.
///
/// # Errors
/// `Fault` when writing into memory fails.
pub(crate) fn encode<L: IntoIterator<Item = String>>(
    header: impl IntoIterator<Item = String>,
    lines: impl IntoIterator<Item = L>,
) -> Result<Vec<u8>> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer.write_record(header).map_err(fault_in("report"))?;
    for line in lines {
        writer.write_record(line).map_err(fault_in("report"))?;
    }
    writer.into_inner().map_err(fault_in("report"))
}
