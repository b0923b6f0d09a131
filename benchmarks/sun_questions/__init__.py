"""Sun questions compared with other tools: ``python -m benchmarks.sun_questions`` writes docs/sun-questions.md."""
