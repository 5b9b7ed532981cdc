"""Parts of the policy that follow its configuration: what they make, read and draw depends on the options."""
