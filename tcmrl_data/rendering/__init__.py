"""Pictures and films of stored episodes, which are played again and compared while they are drawn."""
