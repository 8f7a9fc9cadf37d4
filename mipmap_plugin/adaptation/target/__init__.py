"""The target of the optimization: pseudo ground truth, resized or upsampled, and photographs."""
