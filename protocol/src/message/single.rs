//! Arrays of 32-bit floats of one length: serde alone would narrow doubles and take integers.

use serde::de::{Deserialize, Deserializer, Error, SeqAccess, Visitor};

/// A float that was one on the wire.
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
pub fn one<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f32, D::Error> {
    Single::deserialize(deserializer).map(|single| single.0)
}

/// For `#[serde(deserialize_with)]` on `Option<f32>`.
pub fn maybe_one<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f32>, D::Error> {
    Ok(Option::<Single>::deserialize(deserializer)?.map(|single| single.0))
}

/// For `#[serde(deserialize_with)]` on `[f32; N]`.
pub fn array<'de, D: Deserializer<'de>, const N: usize>(
    deserializer: D,
) -> Result<[f32; N], D::Error> {
    Array::<N>::deserialize(deserializer).map(|array| array.0)
}

/// For `#[serde(deserialize_with)]` on `Option<[f32; N]>`.
pub fn maybe_array<'de, D: Deserializer<'de>, const N: usize>(
    deserializer: D,
) -> Result<Option<[f32; N]>, D::Error> {
    Ok(Option::<Array<N>>::deserialize(deserializer)?.map(|array| array.0))
}

struct Array<const N: usize>([f32; N]);

impl<'de, const N: usize> Deserialize<'de> for Array<N> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Elements<const N: usize>;
        impl<'de, const N: usize> Visitor<'de> for Elements<N> {
            type Value = Array<N>;
            fn expecting(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                write!(formatter, "an array of {N} f32")
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut elements: A) -> Result<Array<N>, A::Error> {
                let mut values = [0.0; N];
                for (index, value) in values.iter_mut().enumerate() {
                    *value = match elements.next_element::<Single>()? {
                        Some(single) => single.0,
                        None => return Err(A::Error::invalid_length(index, &self)),
                    };
                }
                let mut length = N;
                while elements.next_element::<Single>()?.is_some() {
                    length += 1;
                }
                if length > N {
                    Err(A::Error::invalid_length(length, &self))
                } else {
                    Ok(Array(values))
                }
            }
        }
        deserializer.deserialize_seq(Elements::<N>)
    }
}
