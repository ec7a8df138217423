"""Networks that go out to other programs, and come in from them (docs/exchange.md)."""
