// SPDX-License-Identifier: MIT OR Apache-2.0
//! JSON that another program has written: an object is an object.
//!
//! The types of this program are read by field name. What is derived for them also takes a list of their fields in
//! order, and fills up what the list lacks: `[]` is then a remark without a rating, or the wish for a capture. Here a
//! list is refused wherever fields are expected, however deep.

use serde::de::{
    DeserializeOwned, DeserializeSeed, Deserializer, EnumAccess, MapAccess, SeqAccess, VariantAccess, Visitor,
};
use std::fmt;
use std::io::Write;
use std::path::Path;

/// A value that was read in this way.
#[derive(Debug)]
pub struct Strict<T>(pub T);

impl<'de, T: serde::Deserialize<'de>> serde::Deserialize<'de> for Strict<T> {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        T::deserialize(Objects(from)).map(Self)
    }
}

/// Reads a value from the bytes of a JSON text.
///
/// # Errors
/// What is wrong in it, and where.
pub fn from_slice<T: DeserializeOwned>(bytes: &[u8]) -> serde_json::Result<T> {
    serde_json::from_slice(bytes).map(|Strict(value)| value)
}

/// Reads a value from JSON that has been taken apart already.
///
/// # Errors
/// What is wrong in it.
pub fn from_value<T: DeserializeOwned>(value: serde_json::Value) -> serde_json::Result<T> {
    serde_json::from_value(value).map(|Strict(value)| value)
}

/// Writes a value as a JSON file for people, which is never half there.
///
/// # Errors
/// What could not be written; it names the file.
pub fn save(path: &Path, value: &impl serde::Serialize) -> Result<(), String> {
    let failed = |e: &dyn fmt::Display| format!("{}: {e}", path.display());
    let text = serde_json::to_string_pretty(value).map_err(|e| failed(&e))?;
    super::write_whole(path, |file| writeln!(file, "{text}")).map_err(|e| failed(&e))
}

/// A wrapper of every part of a deserializer: it forwards all calls, but requests a map where a structure is expected.
struct Objects<T>(T);

macro_rules! pass_on {
    ($($name:ident($($argument:ident: $kind:ty),*))*) => {
        $(fn $name<V: Visitor<'de>>(self, $($argument: $kind,)* visitor: V) -> Result<V::Value, D::Error> {
            self.0.$name($($argument,)* Objects(visitor))
        })*
    };
}

impl<'de, D: Deserializer<'de>> Deserializer<'de> for Objects<D> {
    type Error = D::Error;

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        _fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        self.0.deserialize_map(Objects(visitor))
    }

    pass_on! {
        deserialize_any() deserialize_bool() deserialize_i8() deserialize_i16() deserialize_i32() deserialize_i64()
        deserialize_i128() deserialize_u8() deserialize_u16() deserialize_u32() deserialize_u64() deserialize_u128()
        deserialize_f32() deserialize_f64() deserialize_char() deserialize_str() deserialize_string()
        deserialize_bytes() deserialize_byte_buf() deserialize_option() deserialize_unit() deserialize_seq()
        deserialize_map() deserialize_identifier() deserialize_ignored_any()
        deserialize_unit_struct(name: &'static str) deserialize_newtype_struct(name: &'static str)
        deserialize_tuple(length: usize) deserialize_tuple_struct(name: &'static str, length: usize)
        deserialize_enum(name: &'static str, variants: &'static [&'static str])
    }

    fn is_human_readable(&self) -> bool {
        self.0.is_human_readable()
    }
}

macro_rules! visit_plain {
    ($($name:ident($kind:ty))*) => {
        $(fn $name<E: serde::de::Error>(self, value: $kind) -> Result<V::Value, E> {
            self.0.$name(value)
        })*
    };
}

impl<'de, V: Visitor<'de>> Visitor<'de> for Objects<V> {
    type Value = V::Value;

    fn expecting(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.expecting(to)
    }

    visit_plain! {
        visit_bool(bool) visit_i64(i64) visit_i128(i128) visit_u64(u64) visit_u128(u128) visit_f64(f64) visit_char(char)
        visit_str(&str) visit_borrowed_str(&'de str) visit_string(String) visit_bytes(&[u8])
        visit_borrowed_bytes(&'de [u8]) visit_byte_buf(Vec<u8>)
    }

    fn visit_none<E: serde::de::Error>(self) -> Result<V::Value, E> {
        self.0.visit_none()
    }

    fn visit_unit<E: serde::de::Error>(self) -> Result<V::Value, E> {
        self.0.visit_unit()
    }

    fn visit_some<D: Deserializer<'de>>(self, from: D) -> Result<V::Value, D::Error> {
        self.0.visit_some(Objects(from))
    }

    fn visit_newtype_struct<D: Deserializer<'de>>(self, from: D) -> Result<V::Value, D::Error> {
        self.0.visit_newtype_struct(Objects(from))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, from: A) -> Result<V::Value, A::Error> {
        self.0.visit_seq(Objects(from))
    }

    fn visit_map<A: MapAccess<'de>>(self, from: A) -> Result<V::Value, A::Error> {
        self.0.visit_map(Objects(from))
    }

    fn visit_enum<A: EnumAccess<'de>>(self, from: A) -> Result<V::Value, A::Error> {
        self.0.visit_enum(Objects(from))
    }
}

impl<'de, S: DeserializeSeed<'de>> DeserializeSeed<'de> for Objects<S> {
    type Value = S::Value;

    fn deserialize<D: Deserializer<'de>>(self, from: D) -> Result<S::Value, D::Error> {
        self.0.deserialize(Objects(from))
    }
}

impl<'de, A: SeqAccess<'de>> SeqAccess<'de> for Objects<A> {
    type Error = A::Error;

    fn next_element_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<Option<S::Value>, A::Error> {
        self.0.next_element_seed(Objects(seed))
    }

    fn size_hint(&self) -> Option<usize> {
        self.0.size_hint()
    }
}

impl<'de, A: MapAccess<'de>> MapAccess<'de> for Objects<A> {
    type Error = A::Error;

    fn next_key_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<Option<S::Value>, A::Error> {
        self.0.next_key_seed(seed)
    }

    fn next_value_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<S::Value, A::Error> {
        self.0.next_value_seed(Objects(seed))
    }

    fn size_hint(&self) -> Option<usize> {
        self.0.size_hint()
    }
}

impl<'de, A: EnumAccess<'de>> EnumAccess<'de> for Objects<A> {
    type Error = A::Error;
    type Variant = Objects<A::Variant>;

    fn variant_seed<S: DeserializeSeed<'de>>(self, seed: S) -> Result<(S::Value, Self::Variant), A::Error> {
        self.0.variant_seed(seed).map(|(variant, content)| (variant, Objects(content)))
    }
}

impl<'de, A: VariantAccess<'de>> VariantAccess<'de> for Objects<A> {
    type Error = A::Error;

    fn unit_variant(self) -> Result<(), A::Error> {
        self.0.unit_variant()
    }

    fn newtype_variant_seed<S: DeserializeSeed<'de>>(self, seed: S) -> Result<S::Value, A::Error> {
        self.0.newtype_variant_seed(Objects(seed))
    }

    fn tuple_variant<V: Visitor<'de>>(self, length: usize, visitor: V) -> Result<V::Value, A::Error> {
        self.0.tuple_variant(length, Objects(visitor))
    }

    fn struct_variant<V: Visitor<'de>>(
        self,
        _fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, A::Error> {
        self.0.newtype_variant_seed(Fields(visitor))
    }
}

/// Reads the fields of a variant as a map.
struct Fields<V>(V);

impl<'de, V: Visitor<'de>> DeserializeSeed<'de> for Fields<V> {
    type Value = V::Value;

    fn deserialize<D: Deserializer<'de>>(self, from: D) -> Result<V::Value, D::Error> {
        from.deserialize_map(Objects(self.0))
    }
}

#[cfg(test)]
mod tests {
    use super::{from_slice, from_value};
    use serde::{Deserialize, Serialize};
    use serde_json::json;
    use std::collections::BTreeMap;

    #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    enum Kind {
        Plain,
        One(Inner),
        Pair(u8, Inner),
        Named { inner: Inner },
    }

    #[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    struct Inner {
        a: u64,
        b: Option<String>,
    }

    #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Outer {
        inner: Inner,
        some: Option<Inner>,
        list: Vec<Inner>,
        map: BTreeMap<String, Inner>,
        pair: (u8, Inner),
        kinds: Vec<Kind>,
        numbers: [f64; 2],
        any: serde_json::Value,
    }

    fn outer() -> Outer {
        let inner = Inner { a: 1, b: Some("b".to_owned()) };
        Outer {
            inner: inner.clone(),
            some: Some(inner.clone()),
            list: vec![inner.clone(); 2],
            map: BTreeMap::from([("key".to_owned(), inner.clone())]),
            pair: (7, inner.clone()),
            kinds: vec![
                Kind::Plain,
                Kind::One(inner.clone()),
                Kind::Pair(3, inner.clone()),
                Kind::Named { inner },
            ],
            numbers: [1.5, -2.0],
            any: json!([1, { "x": [] }, null]),
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let text = serde_json::to_vec(&outer()).expect("JSON");
        assert_eq!(from_slice::<Outer>(&text).expect("as it was"), outer());
        let value = serde_json::to_value(outer()).expect("JSON");
        assert_eq!(from_value::<Outer>(value).expect("as it was"), outer());
    }

    #[test]
    fn a_list_is_no_object_however_deep() {
        for list in [json!([]), json!([1]), json!([1, "b"])] {
            assert!(from_slice::<Inner>(list.to_string().as_bytes()).is_err(), "{list}");
            assert!(from_value::<Inner>(list.clone()).is_err(), "{list}");
            assert!(serde_json::from_value::<Inner>(list.clone()).is_ok(), "what is derived takes {list}");
            let whole = serde_json::to_value(outer()).expect("JSON");
            for place in [
                "/inner",
                "/some",
                "/list/1",
                "/map/key",
                "/pair/1",
                "/kinds/1/one",
                "/kinds/2/pair/1",
                "/kinds/3/named",
                "/kinds/3/named/inner",
            ] {
                let mut forged = whole.clone();
                *forged.pointer_mut(place).expect(place) = list.clone();
                let error = from_slice::<Outer>(forged.to_string().as_bytes()).expect_err(place).to_string();
                assert!(error.contains("sequence"), "{place}: {error}");
                assert!(from_value::<Outer>(forged).is_err(), "{place}");
            }
        }
    }

    #[test]
    fn unknown_missing_and_repeated_fields_are_refused_as_ever() {
        for wrong in ["", "{", "{}", "null", "7", "{\"a\":1,\"c\":2}", "{\"a\":1,\"a\":1}", "{\"a\":1} x"] {
            let refused = match wrong {
                "{}" => from_slice::<Outer>(b"{}").is_err(),
                wrong => from_slice::<Inner>(wrong.as_bytes()).is_err(),
            };
            assert!(refused, "{wrong}");
        }
    }
}
