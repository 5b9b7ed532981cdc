"""DeL-TaCo (Yu & Mooney, ICLR 2023) for LeRobot: what connects the benchmark `gym_deltaco` with LeRobot."""
