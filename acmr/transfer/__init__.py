"""What a student takes from its teacher: the methods, and the teacher's file."""
