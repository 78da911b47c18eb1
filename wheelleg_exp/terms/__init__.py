"""Check the terms of a config against the functions and classes that the terms name, without torch and MuJoCo.

| module | contents |
|---|---|
| `term_binding` | a term node: its target, which must be allowed, the manager's fields, the parameters |
| `config_sections` | the fixed keys of the environment; any section against its dataclass |
| `config_values` | a value against an annotation |
| `term_errors` | every mistake in a term node; exceptions in the code that a config names, with key and line |
| `key_syntax` | config keys and overrides as text |
"""
