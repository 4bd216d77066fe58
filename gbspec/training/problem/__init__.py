"""What is fitted: data packed for stepping, the trainable vector, and the definition of the residual."""
