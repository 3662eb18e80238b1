"""What is known of a robot, asked of its folder and its record: faults, rules, fault trees."""
