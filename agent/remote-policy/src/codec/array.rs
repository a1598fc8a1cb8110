//! NumPy arrays in MessagePack: a map of the bytes, the type and the shape.

use std::borrow::Cow;

use anyhow::{Context, Result, bail, ensure};
use half::f16;

use super::{Key, KeyForm, Value};

/// Maximum number of dimensions of an array.
const RANK_MAX: usize = 8;

/// An array in C order.
#[derive(Debug, Clone, PartialEq)]
pub struct Array<'a> {
    /// The type of an element.
    pub dtype: Dtype,
    /// The length of each dimension; empty for a scalar.
    pub shape: Vec<usize>,
    /// The elements; their number is the product of the shape.
    pub bytes: Cow<'a, [u8]>,
}

/// The type of an array's element.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Dtype {
    kind: Kind,
    /// Bytes of an element.
    width: usize,
    is_big_endian: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Bool,
    Signed,
    Unsigned,
    Float,
}

impl Dtype {
    /// 8-bit pixels.
    pub const U8: Dtype = Dtype { kind: Kind::Unsigned, width: 1, is_big_endian: false };
    /// Token ids.
    pub const U32: Dtype = Dtype { kind: Kind::Unsigned, width: 4, is_big_endian: false };
    /// Numbers.
    pub const F32: Dtype = Dtype { kind: Kind::Float, width: 4, is_big_endian: false };

    /// Parses NumPy's text of a type such as `<f4`, or its name such as `float32`.
    pub fn parse(text: &str) -> Result<Dtype> {
        let refuse = || {
            let got = super::printable(text);
            format!(
                "array: expected a type such as \"<f4\" or \"|u1\" (booleans, integers and floats of up to 8 bytes), \
                 got {got:?}"
            )
        };
        let short = match text {
            "bool" => "|b1",
            "uint8" => "|u1",
            "uint16" => "<u2",
            "uint32" => "<u4",
            "uint64" => "<u8",
            "int8" => "|i1",
            "int16" => "<i2",
            "int32" => "<i4",
            "int64" => "<i8",
            "float16" => "<f2",
            "float32" => "<f4",
            "float64" => "<f8",
            other => other,
        };
        let mut letters = short.chars();
        let order = letters.next().with_context(refuse)?;
        let kind = match letters.next() {
            Some('b') => Kind::Bool,
            Some('i') => Kind::Signed,
            Some('u') => Kind::Unsigned,
            Some('f') => Kind::Float,
            _ => bail!("{}", refuse()),
        };
        let width = letters.as_str().parse().ok().with_context(refuse)?;
        let is_known = match kind {
            Kind::Bool => width == 1,
            Kind::Signed | Kind::Unsigned => [1, 2, 4, 8].contains(&width),
            Kind::Float => [2, 4, 8].contains(&width),
        };
        ensure!(is_known && "<>|=".contains(order), "{}", refuse());
        ensure!(order != '|' || width == 1, "{}", refuse());
        Ok(Dtype { kind, width, is_big_endian: order == '>' })
    }

    /// NumPy's text of this type.
    pub fn text(self) -> String {
        let order = match (self.width, self.is_big_endian) {
            (1, _) => '|',
            (_, true) => '>',
            (_, false) => '<',
        };
        let kind = match self.kind {
            Kind::Bool => 'b',
            Kind::Signed => 'i',
            Kind::Unsigned => 'u',
            Kind::Float => 'f',
        };
        format!("{order}{kind}{}", self.width)
    }

    fn is_integer(self) -> bool {
        matches!(self.kind, Kind::Signed | Kind::Unsigned)
    }

    /// The element as a 64-bit float; `bytes` has its width.
    fn number(self, bytes: &[u8]) -> f64 {
        let mut word = [0; 8];
        word[..bytes.len()].copy_from_slice(bytes);
        if self.is_big_endian {
            word[..bytes.len()].reverse();
        }
        let unsigned = u64::from_le_bytes(word);
        let unused = 64 - 8 * self.width as u32;
        match (self.kind, self.width) {
            (Kind::Bool, _) => f64::from(u8::from(unsigned != 0)),
            (Kind::Unsigned, _) => unsigned as f64,
            (Kind::Signed, _) => ((unsigned << unused) as i64 >> unused) as f64,
            (Kind::Float, 2) => f16::from_bits(unsigned as u16).to_f64(),
            (Kind::Float, 4) => f64::from(f32::from_bits(unsigned as u32)),
            (Kind::Float, _) => f64::from_bits(unsigned),
        }
    }
}

impl<'a> Array<'a> {
    /// Checks that there are bytes for exactly the elements of the shape.
    pub fn new(
        dtype: Dtype,
        shape: Vec<usize>,
        bytes: impl Into<Cow<'a, [u8]>>,
    ) -> Result<Array<'a>> {
        let bytes = bytes.into();
        let rank = shape.len();
        ensure!(rank <= RANK_MAX, "array: expected at most {RANK_MAX} dimensions, got {rank}");
        let elements =
            shape.iter().try_fold(dtype.width, |product, length| product.checked_mul(*length));
        let got = bytes.len();
        ensure!(
            elements == Some(got),
            "array: expected the bytes of shape {shape:?} and type {}, got {got} bytes",
            dtype.text()
        );
        Ok(Array { dtype, shape, bytes })
    }

    /// 32-bit floats of this shape.
    pub fn of_f32(shape: Vec<usize>, numbers: &[f32]) -> Result<Array<'static>> {
        let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        Array::new(Dtype::F32, shape, bytes)
    }

    /// A list of 32-bit integers.
    pub fn of_u32(numbers: &[u32]) -> Result<Array<'static>> {
        let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        Array::new(Dtype::U32, vec![numbers.len()], bytes)
    }

    /// Reads a NumPy array or scalar in either form of keys, a number, or nested lists of numbers.
    pub fn from_value(value: &'a Value<'_>) -> Result<Array<'a>> {
        if value.get("__ndarray__").is_some() {
            return Array::from_map(value);
        }
        if value.get("__npgeneric__").is_some() {
            check_keys(value, &["__npgeneric__", "data", "dtype"])?;
            Dtype::parse(value.field("dtype")?.as_text()?)?;
            return Array::from_numbers(value.field("data")?);
        }
        Array::from_numbers(value)
    }

    fn from_map(value: &'a Value<'_>) -> Result<Array<'a>> {
        check_keys(value, &["__ndarray__", "data", "dtype", "shape"])?;
        let Value::Bytes(bytes) = value.field("data")? else {
            bail!("array: expected bytes as data, got {}", value.field("data")?.kind());
        };
        let dtype = Dtype::parse(value.field("dtype")?.as_text().context("array: dtype")?)?;
        let Value::List(shape) = value.field("shape")? else {
            bail!("array: expected a list as shape, got {}", value.field("shape")?.kind());
        };
        let shape = shape.iter().map(Value::as_integer).collect::<Result<_>>();
        Array::new(dtype, shape.context("array: shape")?, &**bytes)
    }

    /// Nested lists of one length at each depth.
    fn from_numbers(value: &Value<'_>) -> Result<Array<'static>> {
        let mut shape = Vec::new();
        let mut first = value;
        while let Value::List(values) = first {
            shape.push(values.len());
            let Some(next) = values.first() else { break };
            first = next;
        }
        let mut numbers = Vec::new();
        collect(value, &shape, &mut numbers)?;
        Array::of_f32(shape, &numbers)
    }

    /// All elements as 32-bit floats, in C order.
    pub fn to_f32(&self) -> Vec<f32> {
        self.numbers().map(|number| number as f32).collect()
    }

    /// All elements as token ids.
    pub fn to_u32(&self) -> Result<Vec<u32>> {
        let text = self.dtype.text();
        ensure!(self.dtype.is_integer(), "array: expected integers, got type {text}");
        let number = |number: f64| {
            let fits = (0.0..=f64::from(u32::MAX)).contains(&number);
            ensure!(fits, "array: expected integers of 32 bits, got {number}");
            Ok(number as u32)
        };
        self.numbers().map(number).collect()
    }

    fn numbers(&self) -> impl Iterator<Item = f64> {
        self.bytes.chunks_exact(self.dtype.width).map(|bytes| self.dtype.number(bytes))
    }

    /// The map that encodes this array.
    pub fn into_value(self, form: KeyForm) -> Value<'a> {
        let shape = self.shape.iter().map(|length| Value::Integer(*length as i128)).collect();
        let entries = [
            ("__ndarray__", Value::Bool(true)),
            ("data", Value::Bytes(self.bytes)),
            ("dtype", Value::Text(self.dtype.text().into())),
            ("shape", Value::List(shape)),
        ];
        let key = |name: &'static str| Key { name: Cow::Borrowed(name), form };
        Value::Map(entries.into_iter().map(|(name, value)| (key(name), value)).collect())
    }
}

fn collect(value: &Value<'_>, shape: &[usize], numbers: &mut Vec<f32>) -> Result<()> {
    match (value, shape.split_first()) {
        (Value::List(values), Some((length, rest))) => {
            let got = values.len();
            ensure!(got == *length, "array: expected {length} numbers in every list, got {got}");
            values.iter().try_for_each(|value| collect(value, rest, numbers))
        }
        (Value::Bool(value), None) => {
            numbers.push(f32::from(u8::from(*value)));
            Ok(())
        }
        (value, None) => {
            numbers.push(value.as_number().context("array")? as f32);
            Ok(())
        }
        (other, Some(_)) => bail!("array: expected lists of one depth, got {}", other.kind()),
    }
}

/// Refuses keys that an array does not have.
fn check_keys(value: &Value<'_>, known: &[&str]) -> Result<()> {
    let is_known = |name: &str| known.contains(&name);
    match value.entries()?.iter().find(|(key, _)| !is_known(&key.name)) {
        None => Ok(()),
        Some((key, _)) => bail!(
            "array: expected the keys {}, got {:?}",
            known.join(", "),
            super::printable(&key.name)
        ),
    }
}
