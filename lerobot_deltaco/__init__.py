"""DeL-TaCo for LeRobot: the policies, and what collects, trains, evaluates and reports."""
