//! Parser of MTL files: statements by material name.
//!
//! Colors are linear factors, as in glTF; images of colors are sRGB.

use std::collections::BTreeMap;

use super::parse::{parse_number, text_after_key, words};
use crate::error::{Error, Result, invalid};
use crate::load::text::{lines, without_byte_order_mark};
use crate::load::values::{CorrectedValue, Corrections};

/// The statements of one `newmtl`. A missing statement is `None`.
#[derive(Debug, Default, Clone, PartialEq)]
pub(super) struct MtlMaterial {
    pub(super) ambient: Option<[f32; 3]>,
    pub(super) diffuse: Option<[f32; 3]>,
    pub(super) specular: Option<[f32; 3]>,
    pub(super) exponent: Option<f32>,
    /// Whether the illumination model has no highlight: `illum 0` or `illum 1`.
    pub(super) is_matte: bool,
    /// Opacity: `d`, or 1 - `Tr`.
    pub(super) opacity: Option<f32>,
    pub(super) color_map: Option<String>,
    pub(super) alpha_map: Option<String>,
    /// The image of `norm`, `map_Bump`, `map_bump` or `bump`.
    pub(super) normal_map: Option<String>,
    /// Messages about statements that are not supported.
    pub(super) remarks: Vec<String>,
    /// Statements that are not understood.
    pub(super) corrections: Corrections,
}

/// Parses a file. If a name is defined several times, the last definition is used. A statement that is not understood is
/// ignored and added to the corrections of the material.
///
/// # Errors
/// `Invalid` if the text is UTF-16.
pub(super) fn parse(bytes: &[u8]) -> Result<BTreeMap<String, MtlMaterial>> {
    let mut materials = BTreeMap::new();
    let mut current: Option<(String, MtlMaterial)> = None;
    for (index, line) in lines(without_byte_order_mark(bytes)?).enumerate() {
        let Some(key) = words(line).next() else { continue };
        if key == b"newmtl" {
            materials.extend(current.replace((text_after_key(line), MtlMaterial::default())));
        } else if let Some((name, statements)) = &mut current
            && let Err(error) = statements.parse_statement(key, line, name)
        {
            statements.ignore_statement(key, index + 1, name, error)?;
        }
    }
    materials.extend(current);
    Ok(materials)
}

impl MtlMaterial {
    fn ignore_statement(&mut self, key: &[u8], line: usize, material_name: &str, error: Error) -> Result<()> {
        let Error::Invalid { field, expected, given } = error else { return Err(error) };
        let subject = format!("material '{material_name}': {}: {field}", String::from_utf8_lossy(key));
        let value = || CorrectedValue::new(format!("line {line}"), expected, given);
        self.corrections.add(&subject, "the statement is ignored", value);
        Ok(())
    }

    fn parse_statement(&mut self, key: &[u8], line: &[u8], material_name: &str) -> Result<()> {
        match key.to_ascii_lowercase().as_slice() {
            b"ka" => self.ambient = Some(self.parse_color(line, material_name)?),
            b"kd" => self.diffuse = Some(self.parse_color(line, material_name)?),
            b"ks" => self.specular = Some(self.parse_color(line, material_name)?),
            b"ke" => self.note_emission(line, material_name)?,
            b"ns" => self.exponent = Some(parse_last_number(line)?),
            b"illum" => self.is_matte = parse_last_number(line)? < 2.0,
            b"d" => self.opacity = Some(parse_last_number(line)?),
            b"tr" => self.set_transparency(parse_last_number(line)?, material_name),
            b"map_kd" => self.color_map = self.parse_image_path(line, material_name)?,
            b"map_d" => self.alpha_map = self.parse_image_path(line, material_name)?,
            b"norm" | b"map_bump" | b"bump" => self.normal_map = self.parse_image_path(line, material_name)?,
            // Ambient maps repeat the color map. All other statements have no equivalent in `Material`.
            _ => {}
        }
        Ok(())
    }

    /// Parses one number per channel, or one number for all channels. Numbers after the channels, such as an alpha, are not
    /// used.
    fn parse_color(&mut self, line: &[u8], material_name: &str) -> Result<[f32; 3]> {
        let numbers: Option<Vec<f32>> = words(line).skip(1).map(parse_number).collect();
        let color_error = || invalid("color", "one or three numbers", text_after_key(line));
        match numbers.as_deref() {
            Some([gray]) => Ok([*gray; 3]),
            Some([red, green, blue, unused @ ..]) => {
                if !unused.is_empty() {
                    let key = String::from_utf8_lossy(words(line).next().unwrap_or_default());
                    let value = || CorrectedValue::new("", "one or three numbers", text_after_key(line));
                    self.corrections.add(&format!("material '{material_name}': {key}"), "three are used", value);
                }
                Ok([*red, *green, *blue])
            }
            _ => Err(color_error()),
        }
    }

    /// Adds a remark on emission that is not black.
    fn note_emission(&mut self, line: &[u8], material_name: &str) -> Result<()> {
        let is_black = self.parse_color(line, material_name)?.iter().all(|channel| *channel == 0.0);
        let remark = format!("material '{material_name}': emission (Ke) is ignored");
        self.remarks.extend((!is_black).then_some(remark));
        Ok(())
    }

    /// Sets the opacity to 1 - `Tr`, but ignores `Tr 1`: VTK writes the opacity as `Tr`, so its opaque surfaces would
    /// be invisible.
    fn set_transparency(&mut self, transparency: f32, material_name: &str) {
        if transparency == 1.0 {
            self.remarks.push(format!("material '{material_name}': Tr 1 hides the surface, and is read as opaque"));
        } else {
            self.opacity = Some(1.0 - transparency);
        }
    }

    /// The path after the options of an image statement.
    fn parse_image_path(&mut self, line: &[u8], material_name: &str) -> Result<Option<String>> {
        let text = text_after_key(line);
        let mut remainder = text.as_str();
        while let Some((option, text_after_option)) = remainder.strip_prefix('-').map(split_first_word) {
            let max_arguments = match option {
                "s" | "o" | "t" => 3,
                "mm" => 2,
                "blendu" | "blendv" | "cc" | "clamp" | "bm" | "boost" | "imfchan" | "texres" | "type"
                | "colorspace" => 1,
                // The last word is the path.
                _ => usize::from(text_after_option.contains(' ')),
            };
            let remark = format!("material '{material_name}': image option '-{option}' is not used");
            if !self.remarks.contains(&remark) {
                self.remarks.push(remark);
            }
            remainder = text_after_option;
            for argument in 0..max_arguments {
                let (word, text_after_word) = split_first_word(remainder);
                // -s, -o and -t have one to three arguments.
                if argument > 0 && word.parse::<f32>().is_err() {
                    break;
                }
                remainder = text_after_word;
            }
        }
        if remainder.is_empty() {
            return Err(invalid("path", "the name of an image file", "none"));
        }
        Ok(Some(remainder.to_owned()))
    }
}

/// Splits off the first word.
fn split_first_word(text: &str) -> (&str, &str) {
    text.split_once(|character: char| character.is_ascii_whitespace())
        .map_or((text, ""), |(word, remainder)| (word, remainder.trim_start()))
}

/// Parses the last word as a number, because options may precede it as in `d -halo 0.5`.
fn parse_last_number(line: &[u8]) -> Result<f32> {
    let value = words(line).skip(1).last().and_then(parse_number);
    value.ok_or_else(|| invalid("value", "a number", text_after_key(line)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parse_ignores_letter_case_and_image_options() {
        let text = b"# head\nKd 1 0 0\nnewmtl old bark\nKa 0.1 0.2 0.3\nKd 0.5\nNs 7\r\nTr 0.25\n\
            map_Kd -s 2 2 -clamp on my bark.png\nmap_Bump -bm 0.5 maps\\n.png\nnewmtl black\nKd 0 0 0\nd -halo 0.5\n";
        let materials = parse(text).expect("a valid file");
        let bark = &materials["old bark"];
        assert_eq!(bark.ambient, Some([0.1, 0.2, 0.3]));
        assert_eq!(bark.diffuse, Some([0.5; 3]));
        assert_eq!((bark.exponent, bark.opacity), (Some(7.0), Some(0.75)));
        assert_eq!(bark.color_map.as_deref(), Some("my bark.png"));
        assert_eq!(bark.normal_map.as_deref(), Some("maps\\n.png"));
        // One remark for each of the options -s, -clamp and -bm.
        assert_eq!(bark.remarks.len(), 3);
        assert_eq!((materials["black"].diffuse, materials["black"].opacity), (Some([0.0; 3]), Some(0.5)));
    }

    #[test]
    fn transparency_of_1_is_opaque_with_a_remark() {
        let materials = parse(b"newmtl vtk\nTr 1\nnewmtl hidden\nd 0\n").expect("a valid file");
        assert_eq!((materials["vtk"].opacity, materials["hidden"].opacity), (None, Some(0.0)));
        assert_eq!(materials["vtk"].remarks, ["material 'vtk': Tr 1 hides the surface, and is read as opaque"]);
    }

    #[test]
    fn emission_has_a_remark_unless_it_is_black() {
        for (statement, remarks) in [("Ke 0 0.5 0", 1), ("Ke 0 0 0", 0), ("Ke 0.0", 0)] {
            let materials = parse(format!("newmtl lamp\n{statement}\n").as_bytes()).expect("a text");
            assert_eq!(materials["lamp"].remarks.len(), remarks, "{statement}");
        }
    }

    #[test]
    fn statements_that_are_not_understood_are_ignored_with_a_remark() {
        for (statement, remark) in [
            ("Kd 1 2", "Kd: color: expected one or three numbers, got 1 2 (line 2): the statement is ignored"),
            ("Kd 0.5 0 0 1", "Kd: expected one or three numbers, got 0.5 0 0 1: three are used"),
            (
                "Kd spectral a.rfl",
                "Kd: color: expected one or three numbers, got spectral a.rfl (line 2): the statement is ignored",
            ),
            ("Ns", "Ns: value: expected a number, got  (line 2): the statement is ignored"),
            ("map_Kd", "map_Kd: path: expected the name of an image file, got none (line 2): the statement is ignored"),
            (
                "map_Kd -clamp on",
                "map_Kd: path: expected the name of an image file, got none (line 2): the statement is ignored",
            ),
        ] {
            let text = format!("newmtl a\r\n{statement}\r\n");
            let corrections = &parse(text.as_bytes()).expect(statement)["a"].corrections;
            assert_eq!(corrections.remarks(false), Ok(vec![format!("material 'a': {remark}")]));
            assert!(corrections.remarks(true).is_err(), "{statement}: expected an error in strict mode");
        }
        for statement in ["map_Kd -zoom a b.png", "map_Kd -colorspace sRGB a b.png", "map_Kd -zoom 2 a b.png"] {
            let text = format!("newmtl a\n{statement}\n");
            let material = &parse(text.as_bytes()).expect(statement)["a"];
            let path = if statement.contains("-zoom a") { "b.png" } else { "a b.png" };
            assert_eq!((material.color_map.as_deref(), material.remarks.len()), (Some(path), 1));
        }
        assert!(parse(b"\xff\nnewmtl \xff\nmap_Kd \xff").is_ok());
    }
}
