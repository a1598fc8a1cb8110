//! Deserializers that are stricter than serde's: no doubles or integers for 32-bit floats, no
//! missing optional fields.

use serde::de::{Deserialize, Deserializer, Error, Visitor};

/// A float that was encoded in 32 bits.
struct Single(f32);

impl<'de> Deserialize<'de> for Single {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Only;
        impl Visitor<'_> for Only {
            type Value = Single;
            fn expecting(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                formatter.write_str("f32")
            }
            fn visit_f32<E: Error>(self, value: f32) -> Result<Single, E> {
                Ok(Single(value))
            }
        }
        deserializer.deserialize_f32(Only)
    }
}

/// For `#[serde(deserialize_with)]` on `f32`.
pub fn float<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f32, D::Error> {
    Single::deserialize(deserializer).map(|single| single.0)
}

/// For `#[serde(deserialize_with)]` on `Vec<f32>`.
pub fn floats<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<f32>, D::Error> {
    let singles = Vec::<Single>::deserialize(deserializer)?;
    Ok(singles.into_iter().map(|single| single.0).collect())
}

/// For `#[serde(deserialize_with)]` on an `Option` without floats: the value may be nil, but the
/// field must be present.
pub fn optional<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
) -> Result<Option<T>, D::Error> {
    Option::deserialize(deserializer)
}

/// The same for `Option<f32>`.
pub fn optional_float<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f32>, D::Error> {
    Ok(Option::<Single>::deserialize(deserializer)?.map(|single| single.0))
}

/// The same for `Option<Vec<f32>>`.
pub fn optional_floats<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<Option<Vec<f32>>, D::Error> {
    let singles = Option::<Vec<Single>>::deserialize(deserializer)?;
    Ok(singles.map(|singles| singles.into_iter().map(|single| single.0).collect()))
}
