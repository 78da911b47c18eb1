"""Check that each term of a config fits the signature of its function or class, without importing torch or MuJoCo.

| module | contents |
|---|---|
| `term_binding` | a term node: its target, which must be allowed, the manager's fields, the parameters |
| `config_sections` | the fixed keys of the environment; any section against its dataclass |
| `config_values` | a value against an annotation |
| `term_errors` | every mistake in a term node; exceptions in the code that a config names, with key and line |
| `key_syntax` | config keys and overrides as text |
"""
