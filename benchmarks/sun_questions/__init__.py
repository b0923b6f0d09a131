"""Questions about the sun for Skugga and other tools: ``python -m benchmarks.sun_questions`` writes docs/sun-questions.md."""
