"""What is optimized towards: pseudo ground truth, resized or enlarged, and photographs."""
