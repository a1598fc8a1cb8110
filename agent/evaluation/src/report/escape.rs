//! Text made safe for the page: everything that comes from a model, a server or an option passes here.

use anyhow::Context;
use serde::Serialize;

/// Text for element contents and for attribute values in double quotes.
pub fn html(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            // Other control characters are not allowed in HTML at all, not even escaped.
            character if character.is_control() && character != '\n' && character != '\t' => {
                safe.push('\u{fffd}');
            }
            character => safe.push(character),
        }
    }
    safe
}

/// A value as a JavaScript expression that stays inert wherever a script may stand.
///
/// JSON is JavaScript except for two line separators; `<`, `>` and `&` are escaped as well, so that
/// no `</script>` or comment opener survives.
pub fn script(value: &impl Serialize) -> anyhow::Result<String> {
    let json = serde_json::to_string(value).context("data of the report do not encode")?;
    let mut safe = String::with_capacity(json.len());
    for character in json.chars() {
        match character {
            '<' | '>' | '&' | '\u{2028}' | '\u{2029}' | '\u{7f}' => {
                safe.push_str(&format!("\\u{:04x}", character as u32));
            }
            character => safe.push(character),
        }
    }
    Ok(safe)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn markup_becomes_text() {
        assert_eq!(
            html("<img src=x onerror=\"alert('1')\"> & \u{0}"),
            "&lt;img src=x onerror=&quot;alert(&#39;1&#39;)&quot;&gt; &amp; \u{fffd}"
        );
    }

    #[test]
    fn script_data_hold_no_markup_and_decode_to_the_same_text() {
        let text = "</script><!-- & \u{2028} \" \\ é";
        let safe = script(&text).expect("encodes");
        assert!(!safe.contains(['<', '>', '&', '\u{2028}']), "{safe}");
        assert_eq!(serde_json::from_str::<String>(&safe).expect("json"), text);
    }
}
