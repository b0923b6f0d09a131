"""Questions about the sun for all tools: ``python -m benchmarks.sun_questions`` writes docs/reports/sun-questions.md."""
