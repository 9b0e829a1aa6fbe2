//! Checks a JSON value against the part of JSON Schema that our schemas use; an unknown keyword is an error.

use serde_json::Value;

/// Where and how `value` breaks `schema`.
pub fn check(root: &Value, schema: &Value, value: &Value) -> Result<(), String> {
    check_at(root, schema, value, "")
}

fn check_at(root: &Value, schema: &Value, value: &Value, path: &str) -> Result<(), String> {
    let Some(keywords) = schema.as_object() else {
        return Ok(());
    };
    for (keyword, rule) in keywords {
        check_keyword(root, (keyword, rule), value, path)?;
    }
    check_items(root, schema, value, path)
}

fn check_keyword(
    root: &Value,
    (keyword, rule): (&str, &Value),
    value: &Value,
    path: &str,
) -> Result<(), String> {
    let fails = |holds: bool| {
        if holds {
            Ok(())
        } else {
            Err(format!("{path}: {value:.80} breaks {keyword} {rule:.120}"))
        }
    };
    match keyword {
        "$schema" | "$defs" | "title" | "description" | "format" | "items" | "prefixItems" => {
            Ok(())
        }
        "$ref" => {
            let pointer = rule
                .as_str()
                .and_then(|r| r.strip_prefix('#'))
                .unwrap_or("?");
            let target = root.pointer(pointer).ok_or(format!("{path}: no {rule}"))?;
            check_at(root, target, value, path)
        }
        "type" => fails(match rule {
            Value::Array(names) => names.iter().any(|name| is_a(name, value)),
            name => is_a(name, value),
        }),
        "const" => fails(rule == value),
        "enum" => fails(rule.as_array().is_some_and(|all| all.contains(value))),
        "anyOf" | "oneOf" => fails(
            rule.as_array()
                .is_some_and(|all| all.iter().any(|s| check_at(root, s, value, path).is_ok())),
        ),
        "required" => fails(rule.as_array().is_some_and(|all| {
            all.iter()
                .all(|key| value.get(key.as_str().unwrap_or("?")).is_some())
        })),
        "minimum" => fails(!value.is_number() || value.as_f64() >= rule.as_f64()),
        "minItems" => fails(length(value) >= rule.as_u64() || !value.is_array()),
        "maxItems" => fails(length(value) <= rule.as_u64() || !value.is_array()),
        "properties" => rule
            .as_object()
            .into_iter()
            .flatten()
            .try_for_each(|(key, schema)| {
                value.get(key).map_or(Ok(()), |value| {
                    check_at(root, schema, value, &format!("{path}/{key}"))
                })
            }),
        "additionalProperties" => value
            .as_object()
            .into_iter()
            .flatten()
            .try_for_each(|(key, value)| check_at(root, rule, value, &format!("{path}/{key}"))),
        unknown => Err(format!("{path}: the checker does not know {unknown}")),
    }
}

fn check_items(root: &Value, schema: &Value, value: &Value, path: &str) -> Result<(), String> {
    let Some(items) = schema.get("items") else {
        return Ok(());
    };
    for (index, item) in value.as_array().into_iter().flatten().enumerate() {
        check_at(root, items, item, &format!("{path}/{index}"))?;
    }
    Ok(())
}

fn is_a(name: &Value, value: &Value) -> bool {
    match name.as_str() {
        Some("null") => value.is_null(),
        Some("boolean") => value.is_boolean(),
        Some("string") => value.is_string(),
        Some("integer") => value.is_u64() || value.is_i64(),
        Some("number") => value.is_number(),
        Some("array") => value.is_array(),
        Some("object") => value.is_object(),
        _ => false,
    }
}

fn length(value: &Value) -> Option<u64> {
    value.as_array().map(|items| items.len() as u64)
}
