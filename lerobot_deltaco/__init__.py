"""DeL-TaCo for LeRobot: policies, data collection, training, evaluation and reports."""
